"""Tables of a sweep's arms, with measured values beside those that the paper prints."""
