"""Finished runs: opened, compared, and sorted into sweeps."""
