"""Where cases run: in processes of this machine, or on the workers of a Dask scheduler."""
