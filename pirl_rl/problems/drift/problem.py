"""Vehicle drifting, Sec. V-B of the paper: bring a sliding car into the neighbourhood of an unstable drift equilibrium.

The state is x = (e_y, e_psi, v_x, v_y, r, delta, mu): the lateral error (m) and the course error (rad) from a path of
constant curvature, the velocities in the body frame (m/s), the yaw rate (rad/s), the steering angle (rad), and the
friction coefficient, which does not change with time. The control is u = (delta', F_x): the steering rate (rad/s) and
the drive force (N).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pirl_rl.constants import Constant, constant
from pirl_rl.payoffs import Payoff
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.problems.drift import vehicle
from pirl_rl.problems.drift.equilibria import CURVATURE, DEGREE, FRICTION_BAND, SPEED, EquilibriumCurves
from pirl_rl.sets import Box, Plane

FRICTION_RANGE = (0.25, 1.05)  # the friction coefficients outside of B


class VehicleDrift(ReachAvoidProblem):
    """Reach the drift equilibrium for the friction of the state within T = 5 s, before the car leaves lane or limits.

    Args:
        payoff: replaces the indicator of the target.
        horizon: replaces the horizon, in s.
    """

    horizon = 5.0
    states = Box([-2.0, -0.8, 4.0, -8.0, -2.5, -0.7, 0.5], [2.0, 0.8, 12.0, 8.0, 2.5, 0.7, 0.6])
    controls = Box([-1.5, 1000.0], [1.5, 5000.0])
    state_names = ("e_y (m)", "e_psi (rad)", "v_x (m/s)", "v_y (m/s)", "r (rad/s)", "delta (rad)", "mu")
    control_names = ("delta' (rad/s)", "F_x (N)")
    tolerances = {"e_y": 0.2, "e_psi": 4 * DEGREE, "v_x": 0.5, "beta": 4 * DEGREE, "r": 0.2, "delta": 10 * DEGREE}
    limits = {"e_y": 2.0, "e_psi": 0.8, "v_y": 12.0, "r": 2.5, "delta": 0.7}  # of absolute values; B is beyond
    speeds = (3.0, 25.0)  # m/s, the range of v_x outside of B
    friction_band = FRICTION_BAND
    noise = (0.03, 0.015, 0.20, 0.20, 0.05, 0.01)  # of the states but friction, in their units per sqrt(s)

    def __init__(self, payoff: Payoff | None = None, horizon: float | None = None):
        super().__init__(payoff, horizon)
        self.equilibrium_curves = EquilibriumCurves()
        limits, (slow, fast), (low, high) = self.limits, self.speeds, FRICTION_RANGE
        self._tolerances = Constant([*self.tolerances.values(), 0.0])
        # The largest values outside of B of the sizes in `avoid_constraints`.
        largest = [limits["e_y"], limits["e_psi"], -slow, fast, limits["v_y"], limits["r"], limits["delta"], 0.0]
        self._largest = Constant([*largest, -low, high])

    def drift(self, x: Tensor, u: Tensor) -> Tensor:
        e_y, e_psi, v_x, v_y, r, delta, friction = x.unbind(-1)
        v_x, friction = v_x.clamp(min=vehicle.LEAST_SPEED), friction.clamp(*FRICTION_RANGE)
        delta_rate, demand = u.unbind(-1)
        demand = demand.clamp(self.controls.low[1], self.controls.high[1])
        sin_psi, cos_psi = e_psi.sin(), e_psi.cos()
        across, along = v_x * sin_psi + v_y * cos_psi, v_x * cos_psi - v_y * sin_psi
        # Stacked along the first axis, so that each coordinate stays contiguous in memory.
        rates = [
            across,
            r - CURVATURE * along / (1 - CURVATURE * e_y).clamp(min=0.2),
            *vehicle.accelerations(v_x, v_y, r, delta, friction, demand),
            delta_rate.clamp(self.controls.low[0], self.controls.high[0]),
            torch.zeros_like(friction),
        ]
        return torch.stack(rates).movedim(0, -1)

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        columns = torch.zeros(7, 6, dtype=x.dtype, device=x.device)
        columns.diagonal().copy_(constant(self.noise, x))
        return columns.expand(*x.shape, 6)

    # Coordinates and constraints are the first axis of what is computed, so that each stays contiguous in memory, and
    # what constraints share is computed for all of them at once.

    def target_constraints(self, x: Tensor) -> Tensor:
        e_y, e_psi, v_x, v_y, r, delta, friction = x.movedim(-1, 0).split(1)
        beta, yaw, steering = self.equilibrium_curves(friction)
        sideslip = torch.atan(v_y / v_x.clamp(min=vehicle.LEAST_SPEED))
        away = torch.cat([e_y, e_psi + beta, v_x - SPEED, sideslip - beta, r - yaw, delta - steering]).abs()
        low, high = self.friction_band
        # The distance from the middle of the band would round at its edges.
        outside = torch.maximum(low - friction, friction - high)
        return torch.cat([away, outside]).movedim(0, -1) - self._tolerances.like(x)

    def avoid_constraints(self, x: Tensor) -> Tensor:
        e_y, e_psi, v_x, v_y, r, delta, friction = x.movedim(-1, 0).split(1)
        side = v_y.abs()
        # The last but two stands for a sideslip angle beta of 45 degrees.
        sizes = [e_y.abs(), e_psi.abs(), -v_x, v_x, side, r.abs(), delta.abs(), side - v_x, -friction, friction]
        return self._largest.like(x) - torch.cat(sizes).movedim(0, -1)

    def unreachable(self, x: Tensor) -> Tensor:
        """States (*, n) with friction outside the band, (*) bool: friction is constant, and there is no target."""
        low, high = self.friction_band
        return (x[..., 6] < low) | (x[..., 6] > high)

    def around_equilibrium(
        self,
        friction: Tensor,
        e_y: Tensor | None = None,
        e_psi: Tensor | None = None,
        beta: Tensor | None = None,
        r: Tensor | None = None,
    ) -> Tensor:
        """States (N, 7) with v_x = 8 m/s and the given entries (N,); the others are those of the equilibrium."""
        sideslip, yaw, steering = self.equilibrium_curves(friction)
        beta = sideslip if beta is None else beta
        rows = [
            torch.zeros_like(friction) if e_y is None else e_y,
            -sideslip if e_psi is None else e_psi,
            torch.full_like(friction, SPEED),
            SPEED * beta.tan(),
            yaw if r is None else r,
            steering,
            friction,
        ]
        return torch.stack(rows).movedim(0, -1)

    def faces(self, count: int, rng: torch.Generator | None = None) -> tuple[Tensor, Tensor]:
        """Points (count, 7) and values (count,): half on the faces of A, half on those of B, with friction in the band.

        The points are those where every vertex of the box of controls drives the car into the set, so that V is
        continuous. Elsewhere V jumps at the face within a thin layer, less than a centimetre in e_y, since the noise is
        weak. A network cannot resolve the layer, and boundary values there would teach it a wrong V nearby.
        """
        target = _drawn(lambda n: self._target_faces(n, rng), lambda x: self._enters(x, self.reached), count // 2)
        rest = count - count // 2
        avoid = _drawn(lambda n: self._avoid_faces(n, rng), lambda x: self._enters(x, self.failed), rest)
        value = torch.cat([torch.ones(len(target)), torch.zeros(len(avoid))]).to(target)
        return torch.cat([target, avoid]), value

    @property
    def planes(self) -> dict[str, Plane]:
        """The sections in the figures of the paper, through the equilibrium at friction 0.55."""

        def states(**coordinates: Tensor) -> Tensor:
            first = next(iter(coordinates.values()))
            return self.around_equilibrium(torch.full_like(first, 0.55), **coordinates)

        return {
            "beta_r": Plane(
                ("sideslip beta (rad)", "yaw rate r (rad/s)"),
                Box([-math.pi / 4, -2.5], [math.pi / 4, 2.5]),
                lambda points: states(beta=points[..., 0], r=points[..., 1]),
                lambda x: torch.stack([torch.atan2(x[..., 3], x[..., 2]), x[..., 4]], -1),
            ),
            "e_y_e_psi": Plane(
                ("lateral error e_y (m)", "course error e_psi (rad)"),
                Box([-2.0, -0.2], [2.0, 0.8]),
                lambda points: states(e_y=points[..., 0], e_psi=points[..., 1]),
                lambda x: x[..., :2],
            ),
        }

    def _target_faces(self, count: int, rng: torch.Generator | None) -> Tensor:
        """Points (count, 7) of the target with one of its coordinates but friction at its bound."""
        unit = 2 * torch.rand(count, 7, generator=rng, dtype=torch.float64) - 1
        side = torch.randint(6, (count,), generator=rng)
        rows = torch.arange(count)
        unit[rows, side] = unit[rows, side].sign()
        low, high = self.friction_band
        friction = (low + high) / 2 + unit[:, 6] * (high - low) / 2
        offset = unit[:, :6] * torch.tensor(list(self.tolerances.values()), dtype=torch.float64)
        sideslip, yaw, steering = self.equilibrium_curves(friction)
        v_x = SPEED + offset[:, 2]
        columns = [offset[:, 0], offset[:, 1] - sideslip, v_x, v_x * (sideslip + offset[:, 3]).tan()]
        return torch.stack([*columns, yaw + offset[:, 4], steering + offset[:, 5], friction], -1)

    def _avoid_faces(self, count: int, rng: torch.Generator | None) -> Tensor:
        """Points (count, 7) at one of the bounds outside of which B lies; bounds beyond `states` are omitted."""
        x = self.states.sample(count, rng, dtype=torch.float64)
        side = torch.randint(5, (count,), generator=rng)
        sign = torch.where(torch.rand(count, generator=rng, dtype=torch.float64) < 0.5, -1.0, 1.0).double()
        for index, (column, name) in enumerate(((0, "e_y"), (1, "e_psi"), (4, "r"))):
            x[:, column] = torch.where(side == index, sign * self.limits[name], x[:, column])
        x[:, 2] = torch.where(side == 3, torch.full_like(sign, self.speeds[0]), x[:, 2])
        x[:, 3] = torch.where(side == 4, sign * x[:, 2], x[:, 3])
        return x

    def _enters(self, x: Tensor, absorbs) -> Tensor:
        """Whether every vertex of the box of controls drives the states (N, 7) from outside into the set, (N,) bool."""
        corners = torch.cartesian_prod(*torch.tensor([self.controls.low, self.controls.high], dtype=x.dtype).mT)
        step = 1e-5
        inside = [absorbs(x + step * self.drift(x, corner.expand(len(x), 2))) for corner in corners]
        before = [absorbs(x - step * self.drift(x, corner.expand(len(x), 2))) for corner in corners]
        return torch.stack(inside).all(0) & ~torch.stack(before).any(0)


def _drawn(draw, keep, count: int) -> Tensor:
    """`count` of the points of `draw` for which `keep` is true."""
    x = draw(2 * count)
    found = x[keep(x)]
    while len(found) < count:
        x = draw(2 * count)
        found = torch.cat([found, x[keep(x)]])
    return found[:count]
