"""Readers and writers of motion files, with one module per format.

A format that can be imported has a function `read(path) -> Recording` and a subclass of `recording.Recording`
that computes rotations and positions. It is registered by suffix in `importing.recordings.READERS`.
"""
