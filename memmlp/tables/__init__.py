"""Tables of a sweep's arms: measured values beside those that the paper prints."""
