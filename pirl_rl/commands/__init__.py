"""The commands, `python -m pirl_rl.train` and the others. No other modules know Hydra."""
