"""Readers and writers of motion files, one module a format.

A format that can be imported has a function `read(path) -> Recording` and a subclass of `recording.Recording`
that computes rotations and positions; `importing.recordings.READERS` knows it by its suffix.
"""
