"""Digests of the package's code, which all forked processes need and which take most of a second."""

from memmlp.runs.environment import describe_sources

describe_sources()
