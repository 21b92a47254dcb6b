"""Imitation of the best control among a few levels of each coordinate, by the Hamiltonian or by a look ahead."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from pirl_rl.action_values import Flow, hamiltonian, value_ahead
from pirl_rl.actor_rules.base import ActorRule
from pirl_rl.ascent import Objective, best_bounds, improved
from pirl_rl.cubature import Face, absorbing_faces, expected_ahead, free_step
from pirl_rl.errors import ArgumentError
from pirl_rl.holding import held_value, longest_hold
from pirl_rl.networks import Critic
from pirl_rl.operators import masked_mean
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution
from pirl_rl.structure import controlled_channels, is_control_affine, noise_channels
from pirl_rl.switching import FINE_LEVELS, LEVELS, control_levels

INERTIA = 0.1
"""The inertia for an actor whose output is a tanh, and for all actors where the noise depends on the control."""

CHOICE_INERTIA = 0.02
"""The inertia for an actor that chooses among numbers, where the noise does not depend on the control.

Such an actor passes through nothing between two numbers, and must get from a heading of pi to one just above -pi, or
from forwards to backwards. Where sigma depends on u, levels are compared by second differences of V, which are less
exact, and the best of many nearly equal levels would change with each small change of V.
"""

STRIDE = 4
"""Of `FINE_LEVELS` levels a cubature tries every fourth, and then those between the best and its neighbours.

All of them count for the budget.
"""

MOST_PAIRS = 64
"""The largest number of noise channels times controls for which the noise of a step is simulated."""

MOST_HELD = 3
"""The largest number m of controls for which V is evaluated after holding each of their bounds, at 2m states."""

HELD_COST = 8
"""What a point with a held control costs of the budget, times m + 1: V and its gradient there, and V at 2m states."""


class BestControl(ActorRule):
    """The negative mean of T sum_i w_i CE((1 + a_i)/2, (1 + pi_i)/2) over points, Eq. (best_control).

    The points are the collocation points; if the weight of the HJB residual is 0, those of the transitions. a is the
    best action of the Hamiltonian, see `pirl_rl.ascent`, pi the actor's output, and CE the cross-entropy. The weight
    w_i is the range of the Hamiltonian in coordinate i, so that states at which the control hardly matters hardly
    count, and T is the horizon. The gradient in the output before the tanh is T w_i (pi_i - a_i), which does not
    vanish where the tanh is saturated at the wrong bound: unlike a gradient of the Hamiltonian in u, the rule
    corrects such an action.

    For an actor that chooses among k numbers, see `pirl_rl.networks.Actor`, these are the levels, and CE is the
    cross-entropy of its scores, -log softmax(scores)_j for the best level j. Where it chooses several coordinates
    together, j is the best of all combinations of their levels, and w_i the range of the Hamiltonian over these.

    For the coordinates of u on which sigma depends, E V after one step takes the place of the Hamiltonian, divided by
    the length of the step, see `pirl_rl.cubature.expected_ahead`: next to faces the Hessian of a network may have
    the wrong sign. Away from faces the step is longer than a control step, because the second derivatives of a network
    have ripples, over which a longer step takes the mean. Next to faces it is as short as a control step, see
    `pirl_rl.cubature.free_step`. The step has the noise of those channels that depend on the coordinate.
    Coordinates on which the same channels depend take their best levels at once, one block of them after the other.
    With more noise channels times controls than `MOST_PAIRS` the step would be too dear, and the Hamiltonian stays.

    Where the drift is affine in u, sigma does not depend on u, and there are at most `MOST_HELD` controls, the larger
    of V after holding a control and of its tangent takes the place of the Hamiltonian, see
    `pirl_rl.holding.held_value`. It differs from the Hamiltonian where V bends upwards, as between two ways that are
    equally good.

    The Hamiltonian is the limit of a control that is never held. Where a control step is long, as with fewer than a
    hundred of them in the horizon, V after `steps` noise-free control steps takes its place, divided by dt: the first
    step with the candidate, the others with the policy, the rollout algorithm of D. Bertsekas (Rollout, Policy
    Iteration, and Distributed Reinforcement Learning, 2020).

    Each coordinate takes its best level while the others stand still, see `pirl_rl.ascent.improved`. Of many levels a
    cubature does not try all, see `STRIDE`.

    Args:
        problem: the physics.
        simulator: simulates the control steps.
        steps: the number of control steps ahead; 0 takes the Hamiltonian.
        levels: the number of levels of each coordinate of the control among the candidates, bounds included; at least
            2. None takes that of `pirl_rl.switching.control_levels`, and at least five for a look ahead, which is not
            affine in u. An actor that chooses among numbers has its own.
        budget: the largest number of points times controls; of more points the first are taken, so that an update of
            the actor does not cost more with more controls. Where candidates are simulated, it is the largest number of
            simulated states. Each level of each control at each point then needs `steps` of them for a look ahead, and
            w/2 for a cubature with the noise of w channels: each of its 2w ends counts as a quarter, since it needs V
            alone. Where controls are held, each point needs `HELD_COST` times m + 1.
        inertia: what a level loses for each unit of its distance from the actor's output when levels are compared, as a
            share of the range of the Hamiltonian between the two, >= 0; see `pirl_rl.ascent.improved`. Where noise
            grows with |u|, both bounds are good beside a convex obstacle, and the worst control lies between them.
            Without inertia the better bound changes with each small change of V, and an actor that follows comes to
            rest between both. None takes `CHOICE_INERTIA` for an actor that chooses among numbers, if sigma does not
            depend on u, and else `INERTIA`.
        ahead: the length of the step of a cubature away from faces, as a share of the horizon, >= 0. The step is never
            shorter than a control step, so that 0 takes one control step everywhere.
        hold: the time for which controls are held, as a share of the horizon, >= 0; at most that of
            `pirl_rl.holding.longest_hold`. With 0 the Hamiltonian is taken everywhere.

    Raises:
        ArgumentError: `steps`, `inertia`, `ahead` or `hold` is below 0, `levels` below 2, or `budget` below 1.
    """

    trains_choices = True

    def __init__(
        self,
        problem: ReachAvoidProblem,
        simulator: Simulator,
        steps: int = 0,
        levels: int | None = None,
        budget: int = 8_192,
        inertia: float | None = None,
        ahead: float = 0.01,
        hold: float = 0.02,
    ):
        if levels is None:
            levels = max(LEVELS if steps else 2, control_levels(problem))
        negative = steps < 0 or (inertia is not None and inertia < 0) or not ahead >= 0 or not hold >= 0
        if negative or levels < 2 or budget < 1:
            raise ArgumentError(
                "actor_rule: expected steps >= 0, levels >= 2, budget >= 1, inertia >= 0, ahead >= 0 and hold >= 0, "
                f"got {steps}, {levels}, {budget}, {inertia}, {ahead} and {hold}"
            )
        self.simulator, self.steps, self.levels, self.inertia = simulator, steps, levels, inertia
        self.controlled_noise, self.compiles_whole = simulator.controlled_noise, steps == 0
        m, self.budget, self.longest = problem.controls.dim, budget, max(simulator.dt, ahead * problem.horizon)
        self.cubature = steps == 0 and self.controlled_noise and noise_channels(problem) * m <= MOST_PAIRS
        self.channels = controlled_channels(problem) if self.cubature else [[]] * m
        self.flow: Flow = simulator.flow
        affine = levels == 2 and not self.controlled_noise and is_control_affine(problem)
        holds = affine and steps == 0 and m <= MOST_HELD
        self.held = min(hold * problem.horizon, longest_hold(problem, simulator.dt)) if holds else 0.0

    def __call__(self, solution: Solution, replay: TensorDictBase, points: TensorDictBase) -> Tensor:
        actor, choice = solution.actor, solution.actor.choice
        like = points["state"]
        held = self.held if choice is None else 0.0
        if choice:
            levels = choice.combinations(like)
        else:
            levels = torch.linspace(-1, 1, self.levels, dtype=like.dtype, device=like.device).unsqueeze(-1)
        most = self.most_held() if held else self.most_points(levels)
        tau, x = points["tau"][:most], points["state"][:most]
        logits = actor.logits(tau, x)
        with torch.no_grad():
            action = actor.layers[-1](logits)
            if held:
                best, weight = best_bounds(held_value(solution, tau.squeeze(-1), x, held), action)
            else:
                usual = CHOICE_INERTIA if choice and not self.controlled_noise else INERTIA
                inertia = usual if self.inertia is None else self.inertia
                best, weight = self._improved(solution, tau.squeeze(-1), x, action, levels, inertia)
        if choice:
            scores = choice.grouped(logits).movedim(-1, 1)
            entropy = torch.nn.functional.cross_entropy(scores, choice.indices(best), reduction="none")
        else:
            # pi = tanh(z) is 2 sigmoid(2 z) - 1, so that 2 z is the logit of (1 + pi)/2.
            entropy = torch.nn.functional.binary_cross_entropy_with_logits(2 * logits, (1 + best) / 2, reduction="none")
        loss = solution.problem.horizon * (weight * entropy).sum(-1)
        mask = points["mask"][:most] if "mask" in points.keys() else torch.ones_like(loss, dtype=torch.bool)
        return -masked_mean(loss, mask)

    def blocks(self, size: int) -> dict[tuple[int, ...], list[int]]:
        """The groups of `size` coordinates each that take their best levels at once, by the channels of their noise."""
        found: dict[tuple[int, ...], list[int]] = {}
        for group in range(len(self.channels) // size):
            channels = {k for of_one in self.channels[group * size : (group + 1) * size] for k in of_one}
            found.setdefault(tuple(sorted(channels)), []).append(group)
        return found

    def most_held(self) -> int:
        """The largest number of points that the budget allows where controls are held."""
        return max(1, self.budget // (HELD_COST * (len(self.channels) + 1)))

    def most_points(self, levels: Tensor) -> int:
        """The largest number of points that the budget allows, for levels (k, s) of groups of s coordinates."""
        count, size = levels.shape
        blocks = self.blocks(size).items()
        cost = sum(len(groups) * max(1, count * (self.steps or len(channels) / 2)) for channels, groups in blocks)
        return max(1, int(self.budget / cost))

    def _improved(
        self, solution: Solution, tau: Tensor, x: Tensor, action: Tensor, levels: Tensor, inertia: float
    ) -> tuple[Tensor, Tensor]:
        """The action (N, m) with the best levels, block by block, and how much each group matters (N, g), in 1/s."""
        stride = STRIDE if self.cubature and levels.shape == (FINE_LEVELS, 1) else 1
        blocks, order, stakes = self.blocks(levels.shape[1]), [], []
        faces = absorbing_faces(solution.problem, x) if self.cubature else []
        for channels, groups in blocks.items():
            objective, duration = self._objective(solution, tau, x, faces, channels)
            tried = groups if len(blocks) > 1 else None
            action, found = improved(objective, action, levels, inertia, stride, tried)
            order, stakes = order + groups, [*stakes, found / duration]
        weight = torch.cat(stakes, -1).nan_to_num(0.0, 0.0, 0.0)  # no control counts where the physics has no number
        if len(blocks) > 1:
            weight = torch.stack([weight[:, order.index(group)] for group in sorted(order)], -1)
        return action, weight

    def _objective(
        self, solution: Solution, tau: Tensor, x: Tensor, faces: list[Face], channels: tuple[int, ...]
    ) -> tuple[Objective, float | Tensor]:
        """What is maximised, and its unit in s, one number or those of all points (N, 1).

        `faces` are those at x, which only an objective with noise channels needs.
        """
        dt = self.simulator.dt
        if self.steps:
            return value_ahead(solution, self.simulator, tau, x, self.steps, self.flow), dt
        if channels:
            length = free_step(solution.problem, x, faces, channels, dt, self.longest).minimum(tau)
            return expected_ahead(solution, tau, x, faces, length, channels), length.unsqueeze(-1)
        return hamiltonian(solution, tau, x, self.controlled_noise and not self.cubature), 1.0

    def check(self, critic: Critic, exploration_noise: float | None = None) -> None:
        if critic.action_input:
            raise ArgumentError(
                "actor_rule: BestControl differentiates V(tau, x), expected critic.action_input=false, got true"
            )

    def compile(self, compiler: Callable[[Any], Any]) -> None:
        """Compile the simulator's noise-free step."""
        self.flow = compiler(self.simulator.flow)
