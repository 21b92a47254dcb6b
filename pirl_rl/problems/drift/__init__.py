"""Vehicle drifting, Sec. V-B of the paper, and a model of it in three states."""
