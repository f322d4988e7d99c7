"""`memmlp ui`: runs, sweeps and searches on a page of this machine, which is updated while they run."""
