"""Proofs: bounds of the probability of success by enclosures of its HJB inequality, for few states.

A lower bound is about one policy, an upper bound about all of them. Both are about the SDE under continuous feedback,
while certificates are about a simulator that holds its controls. Whatever the payoff is, the hard sets count.
"""

import pirl_rl.proofs.functions  # noqa: F401  (registers the enclosures of torch's functions)
from pirl_rl.proofs.proof import LowerBound, UpperBound
from pirl_rl.proofs.prover import Settings, prove_limit, prove_success

__all__ = ["LowerBound", "Settings", "UpperBound", "prove_limit", "prove_success"]
