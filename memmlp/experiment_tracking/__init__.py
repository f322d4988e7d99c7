"""Loggers, which show runs elsewhere as they happen: MLflow, TensorBoard, W&B.

The run folder stays the record.
"""
