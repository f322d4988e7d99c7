"""Components for memmlp that look after the feet: a memory, a loss term and a metric."""

__version__ = "0.1.0"
