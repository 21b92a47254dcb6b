"""Actor rules: the objectives that the actor ascends. Each rule is one class.

Notation: y = (tau, x) is the state with its time to go, pi(y) the action of the actor, normalised to [-1, 1], and u the
same control in SI units. V(y) is the mean of the critics at pi(y). y' is the state after a transition, r its reward,
and d is 1 if the episode ended with it, else 0.
"""

from pirl_rl.actor_rules.base import ActorRule
from pirl_rl.actor_rules.best_control import BestControl
from pirl_rl.actor_rules.clipped_surrogate import ClippedSurrogate
from pirl_rl.actor_rules.hamiltonian import Hamiltonian
from pirl_rl.actor_rules.look_ahead import LookAhead
from pirl_rl.actor_rules.q import Q
from pirl_rl.actor_rules.sum import Sum

__all__ = ["ActorRule", "BestControl", "ClippedSurrogate", "Hamiltonian", "LookAhead", "Q", "Sum"]
