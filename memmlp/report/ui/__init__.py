"""`memmlp ui`: runs, sweeps and searches on a page of this machine, which follows them while they go on."""
