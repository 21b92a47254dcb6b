"""Benchmarks of speed: each file is a program of its own, and `python -m benchmarks` runs them one after the other."""
