"""Runs: a trained solution, opened from its directory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from omegaconf import DictConfig
from torch import Tensor

from pirl_rl.errors import CheckpointError, ConfigError
from pirl_rl import checkpoint
from pirl_rl.assembly import fitting, make_networks
from pirl_rl.configuration import build, load_config
from pirl_rl.evaluation.trajectories import Trajectories, closed_loop
from pirl_rl.networks import stack
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution


class Run:
    """A trained solution. Numpy arrays in, numpy arrays out; torch tensors in, torch tensors out.

    Attributes:
        problem: the physics.
        solution: the networks, in torch.
        config: the run's configuration.
        update: how far it was trained.
    """

    def __init__(self, solution: Solution, config: DictConfig, update: int):
        self.solution, self.problem, self.config, self.update = solution, solution.problem, config, update

    def value(self, tau, x):
        """V(tau, x), exactly 1 in A and 0 in B: tau (N,) or a number, s; x (N, n), SI."""
        return self._call(self.solution.value, tau, x)

    def policy(self, tau, x):
        """The control (N, m) in SI units."""
        return self._call(self.solution.policy, tau, x)

    def reach_avoid_set(self, p: float, tau: float) -> Callable:
        """The set {x : V(tau, x) > p} as a function of states (N, n) to (N,) bool, Eq. (ra_levelset)."""
        return lambda x: self.value(tau, x) > p

    def simulate(self, tau: float, x, dt: float = 0.01, substeps: int = 1, crossing: str = "bridge", seed: int = 0):
        """Closed-loop paths from states (N, n) over the time tau under the learned policy, as `Trajectories`."""
        simulator = Simulator(self.problem, dt, substeps, crossing)  # type: ignore[arg-type]
        state, wrap = _tensor(x, self.solution)
        rng = torch.Generator(state.device).manual_seed(seed)
        times = torch.full(state.shape[:1], float(tau)).to(state)
        paths = closed_loop(simulator, self.solution.policy, times, state, rng)
        return Trajectories(**{name: wrap(entry) for name, entry in vars(paths).items()})

    def _call(self, function, tau, x):
        state, wrap = _tensor(x, self.solution)
        time = torch.as_tensor(tau, dtype=state.dtype, device=state.device).expand(state.shape[:-1])
        return wrap(function(time.reshape(-1), state.reshape(-1, state.shape[-1])).unflatten(0, state.shape[:-1]))


def _tensor(x, solution: Solution) -> tuple[Tensor, Callable]:
    """The states as the networks want them, and how to give an answer back in the caller's kind."""
    state = torch.as_tensor(x, dtype=solution.dtype, device=solution.device)
    if isinstance(x, Tensor):
        return state, lambda answer: answer.to(x.device)
    return state, lambda answer: np.asarray(answer.cpu())


def load_run(folder: str | Path, trust: Sequence[str] = (), weights: str | None = None, device: str = "cpu") -> Run:
    """Open a run directory.

    Args:
        folder: as `train` or `export` left it.
        trust: modules outside pirl_rl that its configuration may name, e.g. your own problem's.
        weights: file in `checkpoints/`; default the last.
        device: where the networks go.

    Raises:
        ConfigError: not a run directory, or a configuration that names code from elsewhere.
        CheckpointError: no checkpoint, or a broken one.
    """
    folder = Path(folder)
    config = load_config(folder)
    config.device = device
    if weights is not None and Path(weights).name != weights:
        raise CheckpointError(f"weights: expected the name of a file in {folder / checkpoint.FOLDER}, got {weights}")
    path = checkpoint.newest(folder) if weights is None else folder / checkpoint.FOLDER / weights
    state = checkpoint.load(path)
    problem = build(config.env.problem, "env.problem", trust)
    actor, critics = make_networks(config, problem, trust)
    critic = stack(critics)
    with fitting(path):
        for network, entries in zip((actor, critic), checkpoint.network_states(state), strict=True):
            network.load_state_dict(entries)
    return Run(Solution(problem, actor, critic), config, int(state["update"]))


def refuse_links(folder: Path) -> None:
    """A foreign run directory is not to make us write elsewhere.

    Raises:
        ConfigError: naming a link that leads out of it.
    """
    for path in folder.rglob("*"):
        if path.is_symlink() and not path.resolve().is_relative_to(folder.resolve()):
            raise ConfigError(f"{path} leads out of the run directory, to {path.resolve()}")
