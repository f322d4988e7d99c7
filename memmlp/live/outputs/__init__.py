"""Where a live body is sent: other programs, and files."""
