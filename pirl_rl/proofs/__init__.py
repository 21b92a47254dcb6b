"""Proofs: lower bounds of a policy's probability of success by affine arithmetic, for up to three states.

They are about the SDE under continuous feedback, while certificates are about a simulator that holds its controls.
"""

from pirl_rl.proofs.proof import Proof, Settings, load_bound, prove_success

__all__ = ["Proof", "Settings", "load_bound", "prove_success"]
