"""Slow but simple implementations of functions of the package, and problems that several tests use."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from tensordict import TensorDict
from torch import Tensor, nn

import pirl_rl.problems
from pirl_rl.networks import Actor, Critic, stack
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.sets import Box
from pirl_rl.solution import Solution


class FullNoise(ReachAvoidProblem):
    """n states, m controls, w channels; drift and a full sigma depend on state and control, nothing is symmetric."""

    horizon = 1.5

    def __init__(self, n: int, m: int, w: int):
        super().__init__()
        self.n, self.w = n, w
        self.states = Box([-1.0 - 0.1 * i for i in range(n)], [2.0 + 0.1 * i for i in range(n)])
        self.controls = Box([-0.5] * m, [1.5] * m)

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.sin(x.roll(1, -1) + x) + u.sum(-1, keepdim=True) * torch.cos(x)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        row, column = torch.arange(self.n).to(x)[:, None], torch.arange(self.w).to(x)
        phase = x.unsqueeze(-1) + 0.7 * row + 1.3 * column + 0.4 * u.sum(-1)[..., None, None]
        return (0.6 + 0.3 * torch.sin(phase)) / self.w**0.5

    def target_level(self, x: Tensor) -> Tensor:
        return 1.5 - x[..., 0]

    def avoid_level(self, x: Tensor) -> Tensor:
        return x[..., 0] + 0.8


class Winding(FullNoise):
    """`FullNoise` in three dimensions, whose second coordinate is an angle."""

    def __init__(self):
        super().__init__(3, 2, 2)
        self.states = Box([-1.0, -1.1, -1.2], [2.0, 2 * math.pi - 1.1, 2.2], periodic=[1])


class Circle(ReachAvoidProblem):
    """dX = 0.8 dW on the circle [-1, 3): reach the arc |x| <= 0.5 within 2 s; the control does nothing.

    Its level holds on [-1, 3) alone. The way from x = 2.5 over the seam is half as long as the other.
    """

    horizon = 2.0
    states, controls = Box([-1.0], [3.0], periodic=[0]), Box([-1.0], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return 0 * u

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.full_like(x, 0.8).unsqueeze(-1)

    def target_level(self, x: Tensor) -> Tensor:
        outside = (x < -1) | (x >= 3)
        level = torch.minimum(x.abs(), 4 - x) - 0.5
        return torch.where(outside, torch.nan, level).squeeze(-1)

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor:
        """The exit from an interval of length 3, by its eigenfunctions (Feller, volume 2, X.5)."""
        y = (x.squeeze(-1) % 4 - 0.5).clamp(0, 3)
        odd = 2 * torch.arange(200).to(x) + 1
        decay = torch.exp(-0.5 * (0.8 * math.pi * odd / 3) ** 2 * tau[..., None])
        stays = (4 / (math.pi * odd) * torch.sin(math.pi * odd * y[..., None] / 3) * decay).sum(-1)
        return torch.where(tau > 0, 1 - stays, (y * (3 - y) <= 0).to(x))


class Corner(ReachAvoidProblem):
    """Planar Brownian motion with drift; the target is a square, an intersection of four half-planes."""

    horizon = 1.0
    states = Box([-2.0, -2.0], [2.0, 2.0])
    controls = Box([-1.0, -1.0], [1.0, 1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return u

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.eye(2).to(x).expand(*x.shape[:-1], 2, 2)

    def target_constraints(self, x: Tensor) -> Tensor:
        return torch.cat([x - 0.5, -x - 0.5], -1)


SHIPPED = [getattr(pirl_rl.problems, name)() for name in pirl_rl.problems.__all__]
PROBLEMS = [*SHIPPED, FullNoise(1, 1, 2), FullNoise(8, 2, 3), Winding()]


class Conveyor(ReachAvoidProblem):
    """The first state must come to 1 before the second leaves (-1, 1), whose noise grows with the speed of the first.

    On a way of the length d at the speed u the noise has the variance (0.2 + 0.1 / u) d. So the full speed, 1, is best,
    and V is the probability that Brownian motion stays in (-1, 1) for this variance if d <= tau, else 0.
    """

    horizon = 1.0
    states, controls = Box([0.0, -1.1], [1.1, 1.1]), Box([0.5], [1.0])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.cat([u, torch.zeros_like(u)], -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        return torch.stack([torch.zeros_like(u), (0.2 * u + 0.1).sqrt()], -2)

    def target_constraints(self, x: Tensor) -> Tensor:
        return torch.cat([1 - x[..., :1], x[..., 1:].abs() - 1], -1)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        return 1 - x[..., 1:].abs()

    def exact_value(self, tau: Tensor, x: Tensor) -> Tensor:
        way, side = 1 - x[..., 0], x[..., 1:]
        order = torch.arange(1, 80, 2, dtype=x.dtype) * math.pi
        terms = 4 / order * torch.sin(order * (side + 1) / 2) * torch.exp(-(order**2) * 0.3 * way.unsqueeze(-1) / 8)
        return torch.where(way <= tau, terms.sum(-1), 0.0)


def late_states(problem: ReachAvoidProblem, count: int = 400) -> tuple[Tensor, Tensor]:
    """Times to go in the second half of the horizon and states outside A and B."""
    rng = torch.Generator().manual_seed(0)
    x = problem.states.sample(count, rng, torch.float64)
    x = x[problem.interior(x)]
    return problem.horizon * (0.5 + 0.5 * torch.rand(len(x), generator=rng, dtype=x.dtype)), x


def name(problem: ReachAvoidProblem) -> str:
    return f"{type(problem).__name__}-{problem.states.dim}"


def nested_generator(
    value: Callable[[Tensor, Tensor], Tensor], problem: ReachAvoidProblem, tau: Tensor, x: Tensor, u: Tensor
) -> Tensor:
    """L^u V (N,) of V: (N,), (N, n) -> (N,), by nested autograd and the full Hessian."""
    tau, x = tau.detach().requires_grad_(), x.detach().requires_grad_()
    along_tau, along_x = torch.autograd.grad(value(tau, x).sum(), (tau, x), create_graph=True)
    rows = [torch.autograd.grad(column.sum(), x, create_graph=True)[0] for column in along_x.unbind(-1)]
    f, sigma = problem.drift(x, u).detach(), problem.diffusion(x, u).detach()
    trace = (sigma @ sigma.mT * torch.stack(rows, -2)).sum((-2, -1))
    return -along_tau + (f * along_x).sum(-1) + trace / 2


def points(problem: ReachAvoidProblem, count: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """tau, x, normalised action and physical control, in the default dtype."""
    rng = torch.Generator().manual_seed(seed)
    dtype = torch.get_default_dtype()
    tau = problem.horizon * torch.rand(count, generator=rng, dtype=dtype)
    x = problem.states.sample(count, rng, dtype)
    action = 2 * torch.rand(count, problem.controls.dim, generator=rng, dtype=dtype) - 1
    return tau, x, action, problem.controls.denormalize(action)


def make_batch(problem: ReachAvoidProblem, count: int = 24) -> TensorDict:
    """A batch for `PIRLLoss` of random transitions, collocation points (some masked) and boundary points."""
    rng = torch.Generator().manual_seed(7)
    here, there, inside, edge = (points(problem, count, seed) for seed in range(4))
    replay = {
        "tau": here[0].unsqueeze(-1),
        "state": here[1],
        "action": here[2],
        "loc": there[2],
        "next": {
            "tau": there[0].unsqueeze(-1),
            "state": there[1],
            "reward": torch.rand(count, 1, generator=rng),
            "terminated": torch.rand(count, 1, generator=rng) < 0.3,
            "done": torch.ones(count, 1, dtype=torch.bool),
        },
    }
    collocation = {"tau": inside[0].unsqueeze(-1), "state": inside[1], "mask": torch.arange(count) % 3 > 0}
    boundary = {"tau": edge[0].unsqueeze(-1), "state": edge[1], "value": torch.rand(count, generator=rng)}
    boundary["weight"] = torch.rand(count, generator=rng)
    parts = {"replay": replay, "collocation": collocation, "boundary": boundary}
    return TensorDict({key: TensorDict(part, batch_size=[count]) for key, part in parts.items()})


def random_solution(problem: ReachAvoidProblem, dtype: torch.dtype = torch.float64) -> Solution:
    """Weights far from zero, so that every derivative counts."""
    torch.manual_seed(0)
    actor, critic = Actor(problem, (16,), "Tanh").to(dtype), Critic(problem, (16, 16), output="Sigmoid").to(dtype)
    for parameter in critic.parameters():
        nn.init.normal_(parameter, std=0.7)
    return Solution(problem, actor, stack([critic]))
