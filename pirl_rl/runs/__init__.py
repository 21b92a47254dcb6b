"""Finished runs: opening one, comparing several, and tables of sweeps."""
