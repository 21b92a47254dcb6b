"""Sampling of the initial states of episodes, and of points in the interior and on the boundary of the HJB equation."""
