"""Live use of a network: three trackers drive a full body.

A stream needs only NumPy and ONNX Runtime. The export of full graphs and inverse kinematics also need torch.
"""
