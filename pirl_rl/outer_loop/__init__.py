"""The outer loop: rounds of continued trainings, each planned by an advisor from the results of earlier rounds."""
