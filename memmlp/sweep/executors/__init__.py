"""Executors, which start workers: as processes, as jobs of a Slurm cluster, or as tasks of Ray or Dask.

An executor only starts workers; which worker does which run is settled among them (memmlp.sweep.worker).
"""
