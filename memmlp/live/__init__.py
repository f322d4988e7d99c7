"""From trackers to an avatar: three poses in, a body's out. NumPy and ONNX Runtime only."""
