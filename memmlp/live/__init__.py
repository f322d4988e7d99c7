"""A network in an avatar: three trackers' poses in, a body's pose out.

A stream needs NumPy and ONNX Runtime only; torch is for exporting a full graph and for inverse kinematics.
"""
