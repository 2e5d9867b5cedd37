"""Executors: dask workers, or this process."""
