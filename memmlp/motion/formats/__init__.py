"""Readers and writers of motion files, with one module per format; `importing.recordings` registers them."""
