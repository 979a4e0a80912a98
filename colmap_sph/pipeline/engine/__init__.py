"""A stage's jobs, executed on other machines, by an engine that the user has started: Dask."""
