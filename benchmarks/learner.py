"""Time of complete updates on one thread: Ito propagation, compiled and eager, against nested autograd.

    python benchmarks/learner.py [--rounds 60] [--updates 4] [--short] [--json FILE]

An update computes the TD, HJB and boundary losses with their gradients, makes a step of fused Adam, and every second
time updates the actor and the target networks too. All variants have equal networks, points, optimisers and loops.
"nested autograd" differentiates both critics at once by one gradient with create_graph and one Hessian-vector product
per noise channel. These derivatives cannot be compiled; the other terms run eagerly too, or compiled in "nested, others
compiled". "HJB term" is this loss alone, forward and backward. "matrix products" are those of all forward and backward
passes alone, eagerly through torch, without activations, samplers and optimisers: the floor of this machine. All
variants multiply matrices by the library that a training of this size takes.

The variants take turns of a few updates each. Times are those of the processor, medians over all turns. `--short`
measures complete updates in one dimension alone, since to compile the other variants takes minutes.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from benchmarks.record import save
from pirl_rl import compilation
from pirl_rl.actor_rules import Q
from pirl_rl.gradients import with_gradient
from pirl_rl.losses import PIRLLoss
from pirl_rl.networks import Actor, Critic
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.problems import Reach1D
from pirl_rl.products import fast_products
from pirl_rl.sampling.boundary import BoundarySampler
from pirl_rl.sampling.collocation import Collocation
from pirl_rl.sets import Box
from pirl_rl.terms import HJBResidual, Networks

POLYAK = 0.005


class SevenStates(ReachAvoidProblem):
    """The sizes of the drifting vehicle: 7 states, 2 controls, noise on the first 6 states; reach x_1 >= 2."""

    horizon = 5.0
    states = Box([-3.0] * 7, [3.0] * 7)
    controls = Box([-1.0] * 2, [1.0] * 2)

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.sin(x).roll(1, -1) + torch.nn.functional.pad(u, (0, 5))

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return (0.1 * torch.eye(7, 6).to(x)).expand(*x.shape[:-1], 7, 6)

    def target_level(self, x: Tensor) -> Tensor:
        return 2 - x[..., 0]


class NestedResidual(HJBResidual):
    """`HJBResidual` with the generator, Eq. (parabolic_operator), by nested autograd."""

    def residuals(
        self, networks: Networks, points: TensorDictBase, action: Tensor, probes: Tensor | None = None
    ) -> Tensor:
        tau, x, u = points["tau"].squeeze(-1), points["state"], self.problem.controls.denormalize(action)
        f, sigma = self.problem.drift(x, u), self.problem.diffusion(x, u)
        count = len(next(networks.critic.parameters()))
        y = torch.cat([tau.unsqueeze(-1), x], -1).expand(count, -1, -1).contiguous().requires_grad_()
        value = networks.critic(y[..., :1], y[..., 1:], action.expand(count, -1, -1))
        (gradient,) = torch.autograd.grad(value.sum(), y, create_graph=True)
        result = -gradient[..., 0] + (gradient[..., 1:] * f).sum(-1)
        for column in sigma.unbind(-1):
            along = (gradient[..., 1:] * column).sum()
            (product,) = torch.autograd.grad(along, y, create_graph=True)
            result = result + (product[..., 1:] * column).sum(-1) / 2
        return result


@dataclass(frozen=True)
class Shape:
    name: str
    problem: ReachAvoidProblem
    critic: tuple[int, ...]
    transitions: int
    collocation: int = 1_000
    boundary: int = 200


SHAPES = (
    Shape("drift: 8 + 2 inputs, 6 channels, critics 3x64", SevenStates(), (64, 64, 64), 256),
    Shape("1-D: 2 + 1 inputs, 1 channel, critics 3x32", Reach1D(), (32, 32, 32), 128),
)


def make_batch(shape: Shape) -> TensorDict:
    problem, rng = shape.problem, torch.Generator().manual_seed(0)
    collocation = Collocation(problem, shape.collocation, tau_power=1.0).sample(rng)
    boundary = BoundarySampler(problem, shape.boundary // 2, shape.boundary // 2, tau_power=1.0).sample(rng)
    points = Collocation(problem, shape.transitions, tau_power=1.0)
    replay, following = points.sample(rng).exclude("mask"), points.sample(rng).exclude("mask")
    replay["action"] = 2 * torch.rand(shape.transitions, problem.controls.dim, generator=rng) - 1
    following["reward"] = torch.rand(shape.transitions, 1, generator=rng)
    following["terminated"] = following["done"] = torch.rand(shape.transitions, 1, generator=rng) < 0.1
    replay["next"] = following
    return TensorDict({"replay": replay, "collocation": collocation, "boundary": boundary})


class Variant:
    """A variant of the update: `update()` makes a complete update, `hjb()` computes the HJB loss and its gradient."""

    def __init__(self, shape: Shape, nested: bool, compiled: bool):
        torch.manual_seed(0)
        self.loss = PIRLLoss(
            shape.problem,
            Actor(shape.problem, (32, 32)),
            [Critic(shape.problem, shape.critic, action_input=True, root_time=False) for _ in range(2)],
            Q(),
            policy_noise=0.2,
            hjb_delta=None,
            hjb_weight=1.0,
            boundary_weight=1.0,
        )
        self.batch = make_batch(shape)
        self.critics = list(self.loss.qvalue_network_params.parameters())
        self.actor = list(self.loss.actor_network_params.parameters())
        self.pairs = [
            (list(target.values(True, True)), [entry.data for entry in source.values(True, True)])
            for target, source in (
                (self.loss.target_actor_network_params.data, self.loss.actor_network_params),
                (self.loss.target_qvalue_network_params.data, self.loss.qvalue_network_params),
            )
        ]
        self.critic_adam = torch.optim.Adam(self.critics, 1e-4, fused=True)
        self.actor_adam = torch.optim.Adam(self.actor, 1e-4, fused=True)
        wrap: Callable = compilation.compiled if compiled else lambda function: function
        if nested:
            hjb = self.loss.hjb
            self.loss.hjb = NestedResidual(hjb.problem, hjb.noise, hjb.noise_clip, hjb.time, hjb.delta, hjb.probes)
            if compiled:
                self.loss.hjb.residuals = torch.compiler.disable(self.loss.hjb.residuals)  # type: ignore[method-assign]
        self.critic_loss = wrap(with_gradient(self.loss.critic_loss, self.loss.qvalue_network_params))
        self.actor_loss = wrap(with_gradient(self.loss.actor_loss, self.loss.actor_network_params))
        self.hjb_loss = wrap(with_gradient(self._hjb_loss, self.loss.qvalue_network_params))
        self.count = 0

    def update(self) -> None:
        self.count += 1
        self._descend(self.critics, self.critic_loss(self.batch)[-1], self.critic_adam)
        if self.count % 2 == 0:
            self._descend(self.actor, self.actor_loss(self.batch)[-1], self.actor_adam)
            with torch.no_grad():
                for targets, sources in self.pairs:
                    torch._foreach_lerp_(targets, sources, POLYAK)

    def hjb(self) -> None:
        self.hjb_loss(self.batch["collocation"])

    def _hjb_loss(self, points: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        return self.loss.hjb(self.loss.networks, points, TensorDict()), {}

    @staticmethod
    def _descend(params: list[Tensor], gradient: tuple[Tensor, ...], optimiser: torch.optim.Optimizer) -> None:
        for parameter, entry in zip(params, gradient, strict=True):
            parameter.grad = entry.contiguous()
        optimiser.step()


class MatrixProducts:
    """The matrix products of an update, forward and backward."""

    def __init__(self, shape: Shape):
        torch.manual_seed(0)
        problem = shape.problem
        n, m = problem.states.dim, problem.controls.dim
        channels = problem.diffusion(torch.zeros(1, n), torch.zeros(1, m)).shape[-1]
        self.actor, self.critics = _weights((), (1 + n, 32, 32, m)), _weights((2,), (1 + n + m, *shape.critic, 1))
        self.transitions, self.boundary = shape.transitions, shape.boundary
        self.points, self.rows = shape.collocation, (2 + channels) * shape.collocation
        self.count = 0

    def update(self) -> None:
        self.count += 1
        with torch.no_grad():
            for count in filter(None, (self.transitions, self.points, self.boundary)):
                _through(self.actor, count)
            _through(self.critics, self.transitions)
        for count in filter(None, (self.transitions, self.rows, self.boundary)):
            _through(self.critics, count).sum().backward()
        if self.count % 2 == 0:
            _through(self.actor, self.transitions).sum().backward()
            _through([weight.detach() for weight in self.critics], self.transitions, inputs=True).sum().backward()

    def hjb(self) -> None:
        with torch.no_grad():
            _through(self.actor, self.points)
        _through(self.critics, self.rows).sum().backward()


def _weights(stacked: tuple[int, ...], widths: tuple[int, ...]) -> list[Tensor]:
    return [torch.randn(*stacked, wide, width).requires_grad_() for width, wide in itertools.pairwise(widths)]


def _through(weights: list[Tensor], count: int, inputs: bool = False) -> Tensor:
    """The products of `count` rows with all weights; with `inputs`, the rows have a gradient and the weights none."""
    rows = torch.ones(count, weights[0].shape[-1], requires_grad=inputs)
    for weight in weights:
        rows = torch.matmul(rows, weight.mT)
    return rows


def milliseconds(work: Callable[[], None], repeats: int) -> float:
    start = time.process_time()
    for _ in range(repeats):
        work()
    return 1e3 * (time.process_time() - start) / repeats


def measure(shape: Shape, rounds: int, updates: int, short: bool) -> dict[str, Any]:
    """The median times of all variants in ms, and what they say about ours."""
    variants: dict[str, Variant | MatrixProducts] = {
        "nested autograd": Variant(shape, nested=True, compiled=False),
        **({} if short else {"nested, others compiled": Variant(shape, nested=True, compiled=True)}),
        "ours, eager": Variant(shape, nested=False, compiled=False),
        "ours, compiled": Variant(shape, nested=False, compiled=True),
        "matrix products": MatrixProducts(shape),
    }
    parts = {"update": "update"} if short else {"update": "update", "HJB term": "hjb"}
    works = {
        (name, part): getattr(variant, method) for name, variant in variants.items() for part, method in parts.items()
    }
    for work in works.values():
        milliseconds(work, 6)
    times: dict[tuple[str, str], list[float]] = {key: [] for key in works}
    for _ in range(rounds):
        for key, work in works.items():
            times[key].append(milliseconds(work, updates))
    median = {key: statistics.median(entries) for key, entries in times.items()}
    return {"shape": shape.name, "ms": {part: {name: median[name, part] for name in variants} for part in parts}}


def show(row: dict[str, Any]) -> None:
    """Print the times of a shape, and how many times faster than nested autograd each variant is."""
    for part, times in row["ms"].items():
        print(f"\n{row['shape']}\n\n| {part} | ms | times faster |\n|---|--:|--:|")
        for name, time_of in times.items():
            print(f"| {name} | {time_of:.2f} | {times['nested autograd'] / time_of:.2f} |")


def ratios(row: dict[str, Any]) -> dict[str, float]:
    """The times of other variants by that of ours, by shape and part."""
    result = {}
    for part, times in row["ms"].items():
        for other, ours in (
            ("nested autograd", "ours, compiled"),
            ("nested autograd", "ours, eager"),
            ("matrix products", "ours, compiled"),
        ):
            result[f"{part}, {row['shape'].partition(':')[0]}, {other} / {ours}"] = times[other] / times[ours]
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--updates", type=int, default=4)
    parser.add_argument("--short", action="store_true")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore", message="No target network updater")
    print(f"torch {torch.__version__}, 1 thread, medians of {arguments.rounds} x {arguments.updates} updates")
    rows, found = [], {}
    for shape in SHAPES[-1:] if arguments.short else SHAPES:
        with fast_products(2, shape.transitions, max(shape.critic)):
            rows.append(measure(shape, arguments.rounds, arguments.updates, arguments.short))
        show(rows[-1])
        found |= ratios(rows[-1])
    save(arguments.json, found, rows=rows)


if __name__ == "__main__":
    main()
