"""Executors, which start workers: as processes, as jobs of a Slurm cluster, or as tasks of Ray or Dask.

An executor only starts workers; the workers settle among themselves which of them does which run
(memmlp.sweep.worker).
"""
