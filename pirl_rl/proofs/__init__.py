"""Proofs: lower bounds of a policy's probability of success by enclosures of its HJB inequality, for few states.

They are about the SDE under continuous feedback, while certificates are about a simulator that holds its controls.
"""

import pirl_rl.proofs.functions  # noqa: F401  (registers the enclosures of torch's functions)
from pirl_rl.proofs.proof import Proof
from pirl_rl.proofs.prover import Settings, prove_success

__all__ = ["Proof", "Settings", "prove_success"]
