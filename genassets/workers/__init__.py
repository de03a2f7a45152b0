"""Processes that work on the steps of a run side by side (Dask). Importing this package imports no Dask."""
