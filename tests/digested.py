from memmlp.runs.environment import describe_sources

describe_sources()  # of the package's code: most of a second, which forked processes share
