"""The commands: the only modules that know Hydra."""
