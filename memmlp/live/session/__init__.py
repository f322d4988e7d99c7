"""`memmlp live`: a network fed by a clip or by live trackers, watched on a local page."""
