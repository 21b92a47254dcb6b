"""The Hamiltonian of the HJB equation."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from pirl_rl.actor_rules.base import ActorRule
from pirl_rl.operators import advection, generator, masked_mean
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.solution import Solution
from pirl_rl.structure import has_controlled_noise


class Hamiltonian(ActorRule):
    """The mean over points of f(x, u) . grad V + 1/2 Tr(sigma sigma^T hess V) at u = pi(y), Eq. (generator).

    The points are the collocation points; if the weight of the HJB residual is 0, those of the transitions. V is
    differentiated with the action of the critics frozen, so that the gradient reaches the actor through u alone. -d_tau
    V, which does not depend on u, is added, and the second-order term is omitted if sigma does not depend on u.

    Args:
        problem: the physics.
    """

    def __init__(self, problem: ReachAvoidProblem):
        self.problem = problem
        self.operator = generator if has_controlled_noise(problem) else advection

    def __call__(self, solution: Solution, replay: TensorDictBase, points: TensorDictBase) -> Tensor:
        tau, x = points["tau"], points["state"]
        action = solution.actor(tau, x)
        u = self.problem.controls.denormalize(action)
        frozen = solution.critic.at(action.detach())
        value = self.operator(frozen, self.problem, tau.squeeze(-1), x, u).mean(0)
        mask = points["mask"] if "mask" in points.keys() else torch.ones_like(value, dtype=torch.bool)
        return masked_mean(value, mask)
