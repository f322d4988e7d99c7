"""Tables of a sweep's variants, with measured values beside those that the paper prints."""
