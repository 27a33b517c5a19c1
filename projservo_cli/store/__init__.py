"""Files that hold results: the run file, tables of observations and of sweeps, and exports for others."""
