"""The measurements behind the verdict on a solution, see `pirl_rl.evaluation.judgement`."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pirl_rl.action_values import look_ahead_policy
from pirl_rl.arguments import Policy
from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.inputs import like, noise_rng, points_rng
from pirl_rl.evaluation.judgement import Difference, Measures, describe, judge, verdict_of
from pirl_rl.evaluation.largest_residual import largest_residual
from pirl_rl.evaluation.monte_carlo import expected_deviation, mean_payoff, wilson_interval
from pirl_rl.evaluation.other_policies import play_open_loop
from pirl_rl.grid import GridSolution
from pirl_rl.grid.coarse import NODES, coarse_solution
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sampling.initial_states import InitialStates, UniformStates
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution
from pirl_rl.switching import candidate_controls, control_levels

FINER = 2
"""The shorter control step is this part of that of the training."""

SHARE = 4
"""Policies whose paths cost several times as much are played from one state in this many."""

OPEN_LOOP = 8
"""The number of paths of each constant control, and of random ones, from each state."""

LEVELS = 3
"""The least number of levels of each control in the search for a better one."""

STILL = 1e-3
"""A control whose standard deviation over the states is below this share of its half range does not move."""


@dataclass(frozen=True)
class VerdictEvidence:
    """What was measured, and the reasons that follow from it."""

    measures: Measures

    def metrics(self) -> dict[str, float]:
        m = self.measures
        ahead = {} if m.ahead is None else {"success_ahead": m.success + m.ahead.mean}
        grid = {} if m.grid is None else {"success_grid": m.success + m.grid.mean}
        return {
            "success_learned": m.success,
            "success_random": m.random,
            "success_constant": m.constant,
            **ahead,
            **grid,
            "success_finer": m.success + m.finer.mean,
            "value_gap": m.gap,
            "value_gap_noise": m.noise,
            "value_gap_finer": m.gap_finer,
            "value_bias": m.bias.mean,
        }

    def statements(self) -> dict[str, str]:
        """The verdict, its reason and its lines, for the summary."""
        reasons = judge(self.measures)
        level, why = verdict_of(reasons)
        every = " ".join([why, *(reason.why for reason in reasons[1:])])
        return {"verdict": level, "verdict_reason": every, "verdict_lines": "\n".join(self.lines())}

    def lines(self) -> list[str]:
        """The verdict in at most eight lines."""
        return describe(self.measures, judge(self.measures))


class Verdict:
    """Plays the policy beside others that need no training, at the same states, and judges the solution.

    Times to go are uniform in (0, T]. Points and noise are the same at every call.

    Args:
        points: number of states, at least 8.
        rollouts: number of paths from each state, at least 2.
        initial_states: distribution of the states; its steps to go are not used. The default is uniform in the box of
            states, outside A and B.
        seed: seed of points and noise.

    Raises:
        ArgumentError: if there are too few points or rollouts.
    """

    def __init__(
        self, points: int = 400, rollouts: int = 64, initial_states: InitialStates | None = None, seed: int = 0
    ):
        if points < 8 or rollouts < 2:
            raise ArgumentError(f"Verdict: expected points >= 8 and rollouts >= 2, got {points} and {rollouts}")
        self.points, self.rollouts, self.seed = points, rollouts, seed
        self.initial_states = initial_states or UniformStates()

    def meanings(self, problem: ReachAvoidProblem) -> dict[str, str]:
        where = f"from {self.points:,} states and random times to go, {self.rollouts:,} paths each"
        with_grid = "success_learned, plus the gain of the policy of a coarse grid."
        return {
            "success_learned": f"The success of the policy {where}.",
            "success_random": "The success of controls that are drawn at random in each control step, from there.",
            "success_constant": "The success of the best constant control out of the vertices and the centre of the "
            "box of controls, from there.",
            "success_ahead": "success_learned, plus the gain from looking one control step ahead, which is measured "
            f"from one state in {SHARE}.",
            **({"success_grid": with_grid} if problem.states.dim in NODES else {}),
            "success_finer": f"success_learned, plus the gain from control steps that are {FINER} times as short, "
            f"which is measured from one state in {SHARE}.",
            "value_gap": "The mean of |V - Monte Carlo| at these states.",
            "value_gap_noise": "What value_gap would be for a perfect V.",
            "value_gap_finer": f"Like value_gap, with control steps that are {FINER} times as short.",
            "value_bias": "The mean of V - Monte Carlo at these states.",
        }

    def __call__(self, solution: Solution, simulator: Simulator) -> VerdictEvidence:
        problem, rng = solution.problem, points_rng(self.seed)
        # In double precision, so that solutions of any precision are judged at the same states.
        _, x = self.initial_states.sample(problem, self.points, 1, rng, torch.float64)
        fraction = 1 - torch.rand(self.points, generator=rng, dtype=torch.float64)
        tau, x = like(solution, problem.horizon * fraction, x)
        few = slice(0, max(8, self.points // SHARE))

        def play(policy: Policy, rollouts: int, where: slice = slice(None), refinement: int = 1):
            noise = noise_rng(solution, self.seed)
            return mean_payoff(simulator, policy, tau[where], x[where], rollouts, noise, refinement).cpu()

        value = solution.value(tau, x).cpu().double()
        learned = play(solution.policy, self.rollouts)
        gap = (value - learned).abs()
        finely = play(solution.policy, max(2, self.rollouts // 2), few, FINER)
        constant, action, random = play_open_loop(simulator, tau, x, OPEN_LOOP, self.seed)
        u = problem.controls.normalize(solution.policy(tau, x))
        ahead, gain, worst = None, 0.0, 0
        if not isinstance(solution, GridSolution):  # whose policy is the best of its candidates already
            levels = max(LEVELS, control_levels(problem))
            policy = look_ahead_policy(solution, simulator, 1, candidate_controls(problem, levels))
            ahead = _difference(play(policy, max(2, self.rollouts // SHARE), few), learned[few])
            gains = largest_residual(solution, tau, x, along := solution.residual(tau, x), levels) - along
            worst = int(gains.argmax())
            gain = gains[worst].item()
        coarse = None if isinstance(solution, GridSolution) else coarse_solution(problem)
        grid = None if coarse is None else _difference(play(coarse.policy, max(2, self.rollouts // SHARE)), learned)
        low, high = wilson_interval(learned.mean().item() * self.points * self.rollouts, self.points * self.rollouts)
        return VerdictEvidence(
            Measures(
                success=learned.mean().item(),
                low=low,
                high=high,
                random=random.mean().item(),
                constant=constant.mean().item(),
                constant_control=problem.controls.denormalize(action).tolist(),
                over_constant=_difference(constant, learned),
                ahead=ahead,
                grid=grid,
                finer=_difference(finely, learned[few]),
                gap=gap.mean().item(),
                gap_error=gap.std().item() / len(gap) ** 0.5,
                noise=expected_deviation(value, self.rollouts),
                gap_finer=(value[few] - finely).abs().mean().item(),
                noise_finer=expected_deviation(value[few], max(2, self.rollouts // 2)),
                bias=_difference(value, learned),
                value_spread=value.std().item(),
                success_spread=learned.std().item(),
                still=(u.std(0) < STILL).nonzero().flatten().tolist(),
                gain=gain,
                gain_at=x[worst].tolist(),
                states=problem.states.dim,
                invariance=problem.objective == "invariance",
            )
        )


def _difference(other: Tensor, learned: Tensor) -> Difference:
    """The mean of `other` minus `learned`, success (N,) at the same independent states, and its standard error."""
    gap = other - learned
    return Difference(gap.mean().item(), (gap.std() / len(gap) ** 0.5).item())
