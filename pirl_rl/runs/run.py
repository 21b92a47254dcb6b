"""A run: the learned value, policy and reach-avoid sets, simulation, and certificates."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from numbers import Real
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from torch import Tensor

from pirl_rl.action_values import look_ahead_policy
from pirl_rl.arguments import checked_points, points_and_answer, seeded
from pirl_rl.assembly import make_evaluation_simulator, make_simulator, make_starts
from pirl_rl.certificates import Certificate, Deployed, LawOfStarts, OneStart, certify, make_certifiers
from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.monte_carlo import Estimate, monte_carlo
from pirl_rl.evaluation.trajectories import Trajectories, closed_loop
from pirl_rl.grid import GridSolution
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.proofs import LowerBound, Settings, UpperBound, prove_limit, prove_success
from pirl_rl.sampling.initial_states import InitialStates
from pirl_rl.simulator import Crossing, Simulator
from pirl_rl.solution import Solution
from pirl_rl.switching import candidate_controls

AT_ONCE = 2**14
"""The number of states that the networks evaluate at once, so that the nodes of a fine mesh do not fill the memory."""


class Run:
    """A trained solution, for numpy arrays and torch tensors: results are of the kind of the argument x.

    Methods take finite states x (*, n) in SI units and times to go tau in s, a number or an array that broadcasts to
    (*), with 0 <= tau <= horizon.

    Attributes:
        trust: modules outside pirl_rl that the configuration may name.
        solution: the problem and the networks, in torch; the run of a grid has a `GridSolution`.
        config: the run's configuration.
        update: number of updates after which the networks were saved.
        simulator: the simulator of the run's training environment.

    Raises:
        ArgumentError: from every method, for states or times to go of another shape or range.
    """

    def __init__(self, solution: Solution, config: DictConfig, update: int, trust: Sequence[str] = ()):
        self.solution, self.config, self.update, self.trust = solution, config, update, trust
        self.simulator = make_simulator(config, solution.problem)
        self._candidates: dict[int | None, Tensor] = {}  # of a look ahead, by the number of levels

    @property
    def problem(self) -> ReachAvoidProblem:
        """The problem that the run was trained on."""
        return self.solution.problem

    def value(self, tau, x):
        """V(tau, x) (*) in [0, 1], which is exactly 1 in A and 0 in B."""
        return self._call(self.solution.value, tau, x)

    def gradient(self, tau, x):
        """grad_x V (*, n) of the networks, without the masks of A and B, per unit of each state."""
        return self._call(self.solution.gradient, tau, x)

    def residual(self, tau, x):
        """The HJB residual L^pi V (*) in 1/s of the networks under the learned policy, Eq. (linear_pde)."""
        return self._call(self.solution.residual, tau, x)

    def policy(self, tau, x, lookahead: int = 0, levels: int | None = None):
        """The control (*, m) in SI units: that of the actor, or one that looks ahead through the model.

        Args:
            tau: times to go in s, a number or (*).
            x: states (*, n) in SI units.
            lookahead: a number of control steps of the training without noise, the first with a candidate control and
                the others with the actor's. The candidate with the largest V at their end is taken, see
                `pirl_rl.action_values`; with 0, the actor's control is.
            levels: each coordinate of the control has this many candidates, evenly spaced over its range. None takes
                as many as the physics needs, at least five, see `pirl_rl.switching.candidate_controls`.
        """
        chosen = levels is None or (isinstance(levels, int) and levels >= 2)
        if not (isinstance(lookahead, int) and lookahead >= 0 and chosen):
            raise ArgumentError(
                f"policy: expected integers lookahead >= 0 and levels >= 2, got {lookahead!r} and {levels!r}"
            )

        if lookahead and isinstance(self.solution, GridSolution):
            raise ArgumentError(
                "policy: expected lookahead=0 for a grid, whose policy is already the best of its candidates"
            )
        if not lookahead:
            return self._call(self.solution.policy, tau, x)
        # The candidates follow from samples of the physics, which a control loop should not draw in each step.
        if levels not in self._candidates:
            self._candidates[levels] = candidate_controls(self.problem, levels)
        ahead = look_ahead_policy(self.solution, self.simulator, lookahead, self._candidates[levels])
        return self._call(ahead, tau, x)

    def reach_avoid_set(self, p: float, tau: float) -> Callable:
        """The set {x : V(tau, x) > p}, Eq. (ra_levelset), as a function that maps states (*, n) to (*) bool."""
        if not (isinstance(p, Real) and 0 <= p <= 1):
            raise ArgumentError(f"p: expected a probability in [0, 1], got {p!r}")
        self._arguments(tau, [self.problem.states.low])  # refuses a wrong time to go at once
        return lambda x: self.value(tau, x) > p

    def simulate(
        self,
        tau: float,
        x,
        dt: float | None = None,
        substeps: int | None = None,
        crossing: Crossing | None = None,
        seed: int = 0,
    ) -> Trajectories:
        """Simulate one path from each state under the learned policy.

        Args:
            tau: time to go in s; the last control step is shorter where dt does not divide it.
            x: initial states (N, n) in SI units.
            dt: control step in s; the default of this and of the next two is that of the training.
            substeps: number of integration steps in a control step.
            crossing: the rule for the drift of an integration step and for exits within it, see `pirl_rl.simulator`.
            seed: seed of the noise.
        """
        times, state, answer = self._starts(tau, x)
        rng = seeded(seed, state.device)
        paths = closed_loop(self._simulator(dt, substeps, crossing), self.solution.policy, times, state, rng)
        return Trajectories(**{name: answer(entry) for name, entry in vars(paths).items()})

    def monte_carlo(
        self,
        tau,
        x,
        rollouts: int = 1000,
        dt: float | None = None,
        substeps: int | None = None,
        crossing: Crossing | None = None,
        seed: int = 0,
        confidence: float = 0.95,
    ) -> Estimate:
        """Estimate the probability that the learned policy succeeds from each state, with a confidence interval.

        Args:
            tau: times to go in s, a number or (N,).
            x: initial states (N, n) in SI units.
            rollouts: number of paths from each state.
            dt: longest control step in s; the default of this and of the next two is that of the training.
            substeps: number of integration steps in a control step.
            crossing: the rule for the drift of an integration step and for exits within it, see `pirl_rl.simulator`.
            seed: seed of the noise.
            confidence: confidence level of the interval, which is approximate (Wilson 1927).
        """
        times, state, answer = self._starts(tau, x)
        settings = _settings_of(self._simulator(dt, substeps, crossing)) | {"seed": seed, "confidence": confidence}
        estimate = monte_carlo(self.problem, self.solution.policy, times, state, rollouts, **settings)
        entries = (estimate.probability, estimate.low, estimate.high)
        return Estimate(*(answer(torch.as_tensor(entry)) for entry in entries), rollouts=estimate.rollouts)

    def certify(
        self,
        tau: float | None = None,
        x: Sequence[float] | None = None,
        claims: Sequence[str] | None = None,
        starts: InitialStates | None = None,
        episodes: int = 100_000,
        at_least: float | None = None,
        states: int = 1_000,
        rollouts: int = 256,
        share: float = 0.05,
        success: float = 0.9,
        dt: float | None = None,
        substeps: int | None = None,
        crossing: Crossing | None = None,
        confidence: float = 0.95,
        picked_from: int = 1,
        seed: int = 0,
        corollary: bool = False,
    ) -> Certificate:
        """Exact statistical bounds of what the frozen policy does, see `pirl_rl.certificates`.

        Args:
            tau: the time to go of all starts in s; by default that which the law of starts draws.
            x: the state of all starts, n numbers in SI units; by default the law of starts draws them.
            claims: out of `success`, a bound of the probability of success; `threshold`, a c such that almost all
                states with V > c succeed with a wanted probability; and `band`, an eps such that V is within eps of the
                probability of success at almost all states. The default is all of them, or `success` with `x`.
            starts: the law of starts; the default is that of the evaluator `success`.
            episodes: the number of episodes of `success`, one from each start.
            at_least: the episodes of `success` end as soon as this probability is proved, or cannot be.
            states: the number of states of `threshold` and `band`.
            rollouts: the number of paths from each of them.
            share: the share of states about which `threshold` and `band` claim nothing.
            success: the wanted probability of `threshold`.
            dt: control step in s; the default of this and of the next two is that of the evaluators.
            substeps: number of integration steps in a control step.
            crossing: the rule for the drift of an integration step and for exits within it, see `pirl_rl.simulator`.
            confidence: the level of each claim.
            picked_from: the number of runs, or seeds, out of which this one was picked on the same data.
            seed: seed of starts and noise, separate from those of all evaluators.
            corollary: whether the certificate has Corollary 1 of the paper as numbers too: a diagnostic, which bounds
                nothing, see `pirl_rl.certificates.corollary`.
        """
        simulator = _changed(make_evaluation_simulator(self.config, self.problem), dt, substeps, crossing)
        if x is None:
            where = LawOfStarts(make_starts(self.config, self.trust) if starts is None else starts, tau)
            time = self.problem.horizon if tau is None else tau
            checked_points(self.problem, time, [self.problem.states.low], self.solution.dtype, self.solution.device)
        else:
            time = self.problem.horizon if tau is None else tau
            self._starts(time, [x])  # checks both
            where = OneStart(float(time), tuple(torch.as_tensor(x, dtype=torch.float64).tolist()))
        names = claims if claims is not None else ("success",) if x is not None else ("success", "threshold", "band")
        certifiers = make_certifiers(names, episodes, at_least, states, rollouts, share, success)
        return certify(self.solution, simulator, where, certifiers, confidence, picked_from, seed, corollary)

    def prove(
        self, cells: int | None = None, steps: int | None = None, rounds: int = 40, halvings: int = 10
    ) -> LowerBound:
        """Prove a lower bound of the policy's probability of success under continuous feedback, see `pirl_rl.proofs`.

        Args:
            cells: the number of cells of the bound's mesh along each state, at most three; by default 64 with up to
                two states and 16 with three.
            steps: the number of its cells along tau; by default 60 with up to two states and 16 with three.
            rounds: the largest number of times that the bound is fitted to points, and then to boxes.
            halvings: the number of times that a box may be halved.

        Raises:
            ProofError: the problem has too many states, or a function whose enclosure is not known.
        """
        return prove_success(self.solution, self._digest(), Settings(cells, steps, rounds, halvings))

    def prove_limit(
        self, cells: int | None = None, steps: int | None = None, rounds: int = 40, halvings: int = 10
    ) -> UpperBound:
        """Prove an upper bound of the probability of success of every policy, which does not depend on the networks.

        The arguments and the errors are those of `prove`.
        """
        return prove_limit(self.problem, Settings(cells, steps, rounds, halvings))

    def load_proof(self, path: str | Path) -> LowerBound:
        """The bound that `certify method=interval` wrote to a file `proof.npz`.

        Raises:
            ProofError: the file cannot be read, or it is about other networks or another problem than this run's.
        """
        return LowerBound.load(path, self.problem, self._digest())

    def load_limit(self, path: str | Path) -> UpperBound:
        """The bound that `certify method=interval bounds=[upper]` wrote to a file `limit.npz`.

        Raises:
            ProofError: the file cannot be read, or it is about another problem than that of this run.
        """
        return UpperBound.load(path, self.problem)

    def _digest(self) -> str:
        return Deployed(self.solution, self.simulator).digest()

    def _simulator(self, dt: float | None, substeps: int | None, crossing: Crossing | None) -> Simulator:
        return _changed(self.simulator, dt, substeps, crossing)

    def _call(self, function: Callable[[Tensor, Tensor], Tensor], tau, x):
        times, state, answer = self._arguments(tau, x)
        parts = zip(times.reshape(-1).split(AT_ONCE), state.reshape(-1, state.shape[-1]).split(AT_ONCE), strict=True)
        result = torch.cat([function(*part) for part in parts])
        return answer(result.reshape((*times.shape, *result.shape[1:])))

    def _starts(self, tau, x) -> tuple[Tensor, Tensor, Callable[[Tensor], Any]]:
        """The same as `_arguments` for the starts of paths, whose states have the shape (N, n)."""
        times, state, answer = self._arguments(tau, x)
        if state.ndim != 2:
            raise ArgumentError(f"x: expected states of shape (N, {state.shape[-1]}), got {tuple(state.shape)}")
        return times, state, answer

    def _arguments(self, tau, x) -> tuple[Tensor, Tensor, Callable[[Tensor], Any]]:
        """tau (*) and x (*, n) in the networks' dtype, and a function that converts results to the kind of x."""
        return points_and_answer(self.problem, tau, x, self.solution.dtype, self.solution.device)


def _changed(simulator: Simulator, dt: float | None, substeps: int | None, crossing: Crossing | None) -> Simulator:
    """The simulator with other settings; None leaves a setting as it is."""
    given = {"dt": dt, "substeps": substeps, "crossing": crossing}
    return dataclasses.replace(simulator, **{name: value for name, value in given.items() if value is not None})


def _settings_of(simulator: Simulator) -> dict[str, Any]:
    return {name: getattr(simulator, name) for name in ("dt", "substeps", "crossing")}
