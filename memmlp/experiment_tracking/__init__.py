"""Runs shown elsewhere while they happen: MLflow, TensorBoard, W&B. The run folder stays the record."""
