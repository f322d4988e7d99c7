"""`memmlp live`: run a network on a clip or live trackers, and show the motion on a local page."""
