"""Actor rules: what the actor ascends. Each rule is one class with its equation, its arguments and its check.

Notation: y = (tau, x) is the state with its time to go, pi(y) the actor's action in [-1, 1], u the same in physical
units. V(y) is the mean of the critics at pi(y). A prime marks the state after a transition, r its reward, and d is 1
where the episode ended.
"""

from pirl_rl.actor_rules.base import ActorRule
from pirl_rl.actor_rules.clipped_surrogate import ClippedSurrogate
from pirl_rl.actor_rules.hamiltonian import Hamiltonian
from pirl_rl.actor_rules.look_ahead import LookAhead
from pirl_rl.actor_rules.q import Q
from pirl_rl.actor_rules.sum import Sum

__all__ = ["ActorRule", "ClippedSurrogate", "Hamiltonian", "LookAhead", "Q", "Sum"]
