"""`memmlp live`: a network on a clip or on live trackers, watched on a local page."""
