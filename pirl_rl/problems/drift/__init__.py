"""Vehicle drifting, Sec. V-B of the paper: everything that is about this car and nothing else."""
