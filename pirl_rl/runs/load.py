"""A finished run, opened from its directory: the learned value, policy and reach-avoid sets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from pirl_rl import checkpoint
from pirl_rl.assembly import fitting, make_networks, make_problem, make_simulator
from pirl_rl.checkpoint import check_module
from pirl_rl.configuration import load_config
from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.monte_carlo import Estimate, monte_carlo
from pirl_rl.evaluation.trajectories import Trajectories, closed_loop
from pirl_rl.networks import stack
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.run_directory import RunDirectory
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution

ROUNDING = 1e-6
"""tau may exceed the horizon by this part of it: rounding in single precision."""

Crossing = Literal["bridge", "endpoint"]


class Run:
    """A trained solution. Numpy arrays in, numpy arrays out; torch tensors in, torch tensors out.

    Methods take tau, a number or of a shape that broadcasts to (*), in s, 0 <= tau <= horizon, and finite states x
    (*, n) in SI units; they raise `ArgumentError` for others.

    Attributes:
        solution: the networks, in torch.
        config: the run's configuration.
        update: the number of updates after which the networks were saved.
        simulator: the one that the run was trained on.
    """

    def __init__(self, solution: Solution, config: DictConfig, update: int):
        self.solution, self.config, self.update = solution, config, update
        self.simulator = make_simulator(config, solution.problem)

    @property
    def problem(self) -> ReachAvoidProblem:
        """The physics."""
        return self.solution.problem

    def value(self, tau, x):
        """V(tau, x) (*), exactly 1 in A and 0 in B."""
        return self._call(self.solution.value, tau, x)

    def gradient(self, tau, x):
        """grad_x V (*, n), in 1 over the unit of each state, of the networks' own value, which knows no sets."""
        return self._call(self.solution.gradient, tau, x)

    def residual(self, tau, x):
        """L^pi V (*), 1/s: what the HJB equation leaves under the learned policy, by the networks' own value."""
        return self._call(self.solution.residual, tau, x)

    def policy(self, tau, x):
        """The control (*, m) in SI units."""
        return self._call(self.solution.policy, tau, x)

    def reach_avoid_set(self, p: float, tau: float) -> Callable:
        """The set {x : V(tau, x) > p} as a function of states (*, n) to (*) bool, Eq. (ra_levelset)."""
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
        """Closed-loop paths from the states over the time tau under the learned policy.

        Args:
            tau: time to go, s.
            x: states (N, n).
            dt, substeps, crossing: of the simulator; default those that the run was trained on.
            seed: of the noise.
        """
        times, state, answer = self._starts(tau, x)
        rng = torch.Generator(state.device).manual_seed(seed)
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
        """The probability that the learned policy succeeds from each state, with its interval.

        Args:
            tau: time to go, s.
            x: states (N, n).
            rollouts: paths from each state.
            dt, substeps, crossing: of the simulator; default those that the run was trained on.
            seed: of the noise.
            confidence: of the Wilson interval.
        """
        times, state, answer = self._starts(tau, x)
        steps = _steps(self._simulator(dt, substeps, crossing))
        policy = self.solution.policy
        found = monte_carlo(self.problem, policy, times, state, rollouts, **steps, seed=seed, confidence=confidence)
        ends = (answer(torch.as_tensor(entry)) for entry in (found.probability, found.low, found.high))
        return Estimate(*ends, rollouts=found.rollouts)

    def _simulator(self, dt: float | None, substeps: int | None, crossing: Crossing | None) -> Simulator:
        given = {"dt": dt, "substeps": substeps, "crossing": crossing}
        return Simulator(self.problem, **_steps(self.simulator) | {k: v for k, v in given.items() if v is not None})

    def _call(self, function: Callable[[Tensor, Tensor], Tensor], tau, x):
        times, state, answer = self._arguments(tau, x)
        found = function(times.reshape(-1), state.reshape(-1, state.shape[-1]))
        return answer(found.reshape(*times.shape, *found.shape[1:]))

    def _starts(self, tau, x) -> tuple[Tensor, Tensor, Callable[[Tensor], Any]]:
        """As `_arguments`, of paths, which start from a list of states."""
        times, state, answer = self._arguments(tau, x)
        if state.ndim != 2:
            raise ArgumentError(f"x: expected states of shape (N, {state.shape[-1]}), got {tuple(state.shape)}")
        return times, state, answer

    def _arguments(self, tau, x) -> tuple[Tensor, Tensor, Callable[[Tensor], Any]]:
        """Times (*) and states (*, n) as the networks take them, and what gives an answer in the caller's kind."""
        state = torch.as_tensor(x, dtype=self.solution.dtype, device=self.solution.device)
        dim, horizon = self.problem.states.dim, self.problem.horizon
        if state.ndim < 1 or state.shape[-1] != dim:
            raise ArgumentError(f"x: expected states of shape (*, {dim}), got {tuple(state.shape)}")
        if not bool(state.isfinite().all()):
            raise ArgumentError("x: expected finite states, got NaN or infinite ones")
        times, shape = torch.as_tensor(tau, dtype=state.dtype, device=state.device), state.shape[:-1]
        try:
            times = times.expand(shape)
        except RuntimeError:
            message = f"tau: expected a number or the shape {tuple(shape)} of the states, got {tuple(times.shape)}"
            raise ArgumentError(message) from None
        if not bool(((times >= 0) & (times <= horizon * (1 + ROUNDING))).all()):
            raise ArgumentError(f"tau: expected 0 <= tau <= horizon = {horizon} s, got {tau}")
        if isinstance(x, Tensor):
            return times, state, lambda answer: answer.to(x.device)
        return times, state, lambda answer: np.asarray(answer.cpu())


def _steps(simulator: Simulator) -> dict[str, Any]:
    return {name: getattr(simulator, name) for name in ("dt", "substeps", "crossing")}


def load_run(
    folder: str | Path,
    trust: Sequence[str] = (),
    weights: str | None = None,
    device: str = "cpu",
    problem: ReachAvoidProblem | None = None,
) -> Run:
    """Open a run directory.

    Args:
        folder: as training or `python -m pirl_rl.export` left it.
        trust: modules outside pirl_rl that its configuration may name, e.g. that of your own problem.
        weights: a file in `checkpoints/`; default the last.
        device: where the networks go.
        problem: the problem of a run whose configuration cannot name it, as it was trained on an object; it takes the
            place of `env.problem`.

    Raises:
        ConfigError: not a run directory, or a configuration that names code from elsewhere, or no problem.
        CheckpointError: no checkpoint, a broken one, or one that does not fit the configuration.
    """
    run = RunDirectory(folder)
    config = load_config(folder)
    config.device = device
    path = run.newest() if weights is None else run.checkpoint(weights)
    state = checkpoint.load(path)
    problem = make_problem(config, trust) if problem is None else problem
    actor, critics = make_networks(config, problem, trust)
    critic = stack(critics)
    for network, entries in zip((actor, critic), checkpoint.network_states(state), strict=True):
        with fitting(path):
            check_module(entries, network.state_dict())
        network.load_state_dict(entries)
    return Run(Solution(problem, actor, critic), config, int(state["update"]))
