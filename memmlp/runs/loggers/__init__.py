"""Loggers show runs in MLflow, TensorBoard or W&B; the run's folder stays the record."""
