"""`memmlp ui`: a local web page of runs, sweeps and searches, with updates while they run."""
