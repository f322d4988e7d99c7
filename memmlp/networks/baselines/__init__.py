"""The baselines: networks that the paper compares Mem-MLP with, made from their papers."""
