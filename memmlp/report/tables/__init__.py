"""Tables of a sweep's variants, with measured values and the values printed in the paper."""
