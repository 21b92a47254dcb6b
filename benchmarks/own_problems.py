"""The default recipe on problems of other kinds than those of the suite, against the grid.

    python benchmarks/own_problems.py [NAME ...] [--seed 50] [--settings KEY=VALUE ...] [--out FOLDER] [--json FILE]

Each is written as a user would write it. Gusty and Slalom, with other seeds and states, were among the problems on
which the logarithms of the levels, the numbers and widths of the layers and the rules of where episodes start were
chosen, and Gusty on which the inertia of `BestControl` and the choices of the actor were; the others had no part in any
choice. V and the success of the learned policy are compared with the grid, in the way of the suite, at 400 states with
1,000 paths from each. A run takes minutes; a finished one is loaded, so that other settings need another folder.
"""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import asdict
from pathlib import Path

import torch
import yaml
from torch import Tensor

import pirl_rl
from benchmarks.record import save
from pirl_rl import Box, ReachAvoidProblem
from pirl_rl.scoring import Score, find_truth, markdown, measure

POINTS = {1: 801, 2: 161, 3: 81}
"""The nodes of the grid along each axis, by the number of states."""

STATES, ROLLOUTS = 400, 1_000

STATES_SEED = 31_000
"""The seed of the states at which runs are measured; no training uses it."""


def rows(*entries: Tensor) -> Tensor:
    return torch.stack(entries, -1)


def constant(x: Tensor, *matrix: list[float]) -> Tensor:
    """The same matrix (n, w) at all states (*, n)."""
    sigma = x.new_tensor(matrix)
    return sigma.expand(*x.shape[:-1], *sigma.shape)


class Servo(ReachAvoidProblem):
    """Bring a motor with dry friction to rest near the middle; noise acts on the speed alone."""

    horizon = 2.5
    states, controls = Box([-1.5, -2.0], [1.5, 2.0]), Box([-1.5], [1.5])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        speed = x[..., 1]
        return rows(speed, u[..., 0] - 0.6 * speed - 0.3 * torch.tanh(8 * speed))

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.0], [0.35])

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows(x[..., 0].abs() - 0.15, x[..., 1].abs() - 0.3)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return 1.2 - x[..., :1].abs()


class Steering(ReachAvoidProblem):
    """Drift towards a gate that must be met; noise is correlated, and the gain of the control grows away from 0."""

    horizon = 2.0
    states, controls = Box([-1.0, -1.0], [1.0, 1.0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        gain = 2 * (0.3 + x[..., 0].square())
        return rows(torch.full_like(gain, 0.8), gain * u[..., 0] - 0.5 * x[..., 1])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.2, 0.0], [0.25, 0.25])

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows(0.8 - x[..., 0], x[..., 1].abs() - 0.3)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return 1 - x[..., 1:].abs()


class Evader(ReachAvoidProblem):
    """Keep away from a pursuer, who is slower; the states are the distance between both."""

    objective = "invariance"
    horizon = 3.0
    states, controls = Box([-2.0, -2.0], [2.0, 2.0]), Box([-1.0, -1.0], [1.0, 1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u - 0.7 * x / x.norm(dim=-1, keepdim=True).clamp(min=0.2)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.35, 0.0], [0.0, 0.35])

    def avoid_level(self, x: Tensor) -> Tensor:
        return x.norm(dim=-1) - 0.5


class Gusty(ReachAvoidProblem):
    """Reach a disc behind a rock in a box, with noise that grows with the control."""

    horizon = 2.5
    states, controls = Box([-1.5, -1.5], [1.5, 1.5]), Box([-1.0, -1.0], [1.0, 1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u + 0.4 * rows(x[..., 1], -x[..., 0])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.diag_embed(0.15 + 0.25 * u.abs())

    def target_level(self, x: Tensor) -> Tensor:
        return (x - 0.8).norm(dim=-1) - 0.3

    def avoid_level(self, x: Tensor) -> Tensor:
        return torch.minimum(x.norm(dim=-1) - 0.35, 1.4 - x.abs().amax(-1))


class TwoTanks(ReachAvoidProblem):
    """Keep the levels of two tanks, of which one flows into the other, within bounds; noise grows with the level."""

    objective = "invariance"
    horizon = 4.0
    states, controls = Box([0.1, 0.1], [1.0, 1.0]), Box([0.0, 0.0], [0.5, 0.5])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        flow = x.clamp(min=1e-3).sqrt()
        return u + rows(-0.3 * flow[..., 0], 0.3 * flow[..., 0] - 0.35 * flow[..., 1])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.diag_embed(0.05 + 0.2 * x)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return torch.cat([x - 0.2, 0.9 - x], -1)


class Reservoir(ReachAvoidProblem):
    """Let a stock with logistic growth and geometric noise recover before it collapses; the control harvests it."""

    horizon = 5.0
    states, controls = Box([0.0], [3.0]), Box([0.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return 0.8 * x * (1 - x / 2) - u * x

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (0.35 * x).unsqueeze(-1)

    def target_constraints(self, x: Tensor) -> Tensor:
        return 2.4 - x

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return x - 0.3


class Slalom(ReachAvoidProblem):
    """Steer a cart of constant speed between two rocks into a disc; the heading is periodic."""

    horizon = 4.0
    states = Box([-2.0, -1.0, -math.pi], [2.0, 1.0, math.pi], periodic=[2])
    controls = Box([-2.0], [2.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return rows(x[..., 2].cos(), x[..., 2].sin(), u[..., 0])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [0.15, 0.0, 0.0], [0.0, 0.15, 0.0], [0.0, 0.0, 0.2])

    def target_level(self, x: Tensor) -> Tensor:
        return (x[..., :2] - x.new_tensor([1.5, 0.0])).norm(dim=-1) - 0.35

    def avoid_level(self, x: Tensor) -> Tensor:
        rocks = x.new_tensor([[-0.5, 0.4], [0.5, -0.4]])
        return (x[..., None, :2] - rocks).norm(dim=-1).amin(-1) - 0.4


class Orbit(ReachAvoidProblem):
    """Come to rest at a station within an hour, in metres and seconds, before a wall on either side."""

    horizon = 3_600.0
    states, controls = Box([-1e5, -200.0], [1e5, 200.0]), Box([-0.2], [0.2])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return rows(x[..., 1], u[..., 0])

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return constant(x, [200.0, 0.0], [0.0, 1.0])

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows(x[..., 0].abs() - 1e4, x[..., 1].abs() - 30)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return 9.5e4 - x[..., :1].abs()


class Ring(ReachAvoidProblem):
    """Drive round a ring road, past a block on its inner lane, into a parking lot; radius and periodic angle."""

    horizon = 3.0
    states = Box([0.7, -math.pi], [1.8, math.pi], periodic=[1])
    controls = Box([-1.0, -1.0], [1.0, 1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return rows(u[..., 0] - 0.3 * (x[..., 0] - 1.2), u[..., 1] / x[..., 0].clamp(min=0.5))

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.diag_embed(rows(torch.full_like(x[..., 0], 0.2), 0.2 / x[..., 0].clamp(min=0.5)))

    def target_constraints(self, x: Tensor) -> Tensor:
        return rows(math.cos(0.3) - x[..., 1].cos(), (x[..., 0] - 1.25).abs() - 0.2)

    def avoid_level(self, x: Tensor) -> Tensor:
        block = torch.maximum(math.cos(0.25) - (x[..., 1] - 2).cos(), x[..., 0] - 1.3)
        return torch.minimum(0.45 - (x[..., 0] - 1.25).abs(), block)


PROBLEMS = {kind.__name__: kind for kind in (Servo, Steering, Evader, Gusty, TwoTanks, Reservoir, Slalom, Orbit, Ring)}


def measured(name: str, seed: int, out: Path, settings: dict) -> Score:
    """Train a problem, or load its finished run, and compare it with the grid."""
    problem, folder = PROBLEMS[name](), out / f"{name}-{seed}"
    truth = find_truth(problem, STATES, STATES_SEED, POINTS)
    if not (folder / "summary.json").exists():
        pirl_rl.train(problem, folder=folder, seed=seed, report=False, **{"evaluation.during": []}, **settings)
    run = pirl_rl.load_run(folder, problem=problem)
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return measure(run.solution, run.simulator, truth, ROLLOUTS, summary["wall_seconds"], int(summary["updates"]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(PROBLEMS)}; all by default")
    parser.add_argument("--seed", type=int, default=50)
    parser.add_argument("--settings", nargs="*", default=[], metavar="KEY=VALUE", help="of all trainings")
    parser.add_argument("--out", type=Path, default=Path("runs/own_problems"))
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    if unknown := {*arguments.names} - PROBLEMS.keys():
        parser.error(f"expected names out of {', '.join(PROBLEMS)}, got {', '.join(sorted(unknown))}")
    settings = {key: yaml.safe_load(value) for key, _, value in (text.partition("=") for text in arguments.settings)}
    scores = {name: measured(name, arguments.seed, arguments.out, settings) for name in arguments.names or PROBLEMS}
    found = {name: asdict(score) for name, score in scores.items()}
    save(arguments.json, {}, seed=arguments.seed, settings=settings, problems=found)
    print(markdown({name: [score] for name, score in scores.items()}, dict.fromkeys(scores, "grid")))


if __name__ == "__main__":
    main()
