"""Tables of a sweep's arms: what was measured beside what the paper prints."""
