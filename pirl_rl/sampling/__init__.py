"""Where states and points come from: starts of episodes, interior points of the PDE, and its boundary."""
