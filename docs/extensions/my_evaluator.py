"""An evaluator of one's own: the times at which paths arrive, with two metrics and a figure."""

from dataclasses import dataclass

import torch
from matplotlib.figure import Figure
from torch import Tensor

from pirl_rl.errors import ArgumentError
from pirl_rl.evaluation.trajectories import closed_loop
from pirl_rl.figures import draw
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution


@dataclass(frozen=True)
class ArrivalsEvidence:
    """What was measured.

    Attributes:
        times: time of arrival of each path that reached the target, s.
        paths: the number of paths that were simulated.
    """

    times: Tensor
    paths: int

    def metrics(self) -> dict[str, float]:
        mean = self.times.mean().item() if len(self.times) else float("nan")
        return {"arrival_share": len(self.times) / self.paths, "arrival_time": mean}


class Arrivals:
    """Paths over the whole horizon from random states in the box.

    Args:
        paths: their number, at least 1.
        seed: seed of the states and the noise.

    Raises:
        ArgumentError: no path.
    """

    def __init__(self, paths: int = 1_000, seed: int = 0):
        if paths < 1:
            raise ArgumentError(f"Arrivals: expected paths >= 1, got {paths}")
        self.paths, self.seed = paths, seed

    def meanings(self, problem: ReachAvoidProblem) -> dict[str, str]:
        start = f"{self.paths:,} paths of {problem.horizon:g} s from random states in the box"
        return {
            "arrival_share": f"The share of {start} that reaches the target.",
            "arrival_time": f"The mean time of arrival in s of those of {start} that reach the target.",
        }

    def __call__(self, solution: Solution, simulator: Simulator) -> ArrivalsEvidence:
        problem, rng = solution.problem, torch.Generator().manual_seed(self.seed)
        x = problem.states.sample(self.paths, rng).to(solution.device, solution.dtype)
        tau = torch.full((self.paths,), problem.horizon).to(x)
        noise = torch.Generator(solution.device).manual_seed(self.seed + 1)
        paths = closed_loop(simulator, solution.policy, tau, x, noise)
        return ArrivalsEvidence((paths.steps[paths.reached] * simulator.dt).cpu(), self.paths)


@draw.register
def draw_arrivals(evidence: ArrivalsEvidence) -> dict[str, Figure]:
    """A histogram of the times of arrival; the key names the file in `figures/`."""
    figure = Figure(figsize=(5, 3), layout="constrained")
    axes = figure.subplots()
    axes.hist(evidence.times.numpy(), bins=20)
    axes.set(xlabel="time of arrival (s)", ylabel="paths")
    return {"arrivals": figure}
