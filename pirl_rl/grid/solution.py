"""The value and the policy on a mesh, interpolated, with the estimate of the error."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pirl_rl.errors import ArgumentError, CheckpointError
from pirl_rl.files import replacing
from pirl_rl.grid.estimate import Estimate
from pirl_rl.grid.faces import mean_beyond_faces
from pirl_rl.grid.field import Field
from pirl_rl.grid.mesh import Mesh
from pirl_rl.problem import ReachAvoidProblem

SMALLEST = 1e-6
"""The smallest V, and 1 - V, whose log-odds are extrapolated. V itself is known to 1e-7 in each step."""

SHARE = 1 / 3
"""The share of the distance of both solutions by which V is extrapolated where drift and noise act in turns.

It removes an error of second order in the distance of the nodes. Of the shares 0, 1/4, 1/3, 1/2 and 0.7, 1/4 and 1/3
leave the smallest errors on half-spaces with weak noise and on the Dubins car.
"""


class GridSolution:
    """V, multilinear in x and linear in sqrt(tau) between the nodes, and an optimal policy.

    Beyond the mesh V and the policy are those of the nearest point of its edge. In every method tau is (P,), in s, and
    x is (P, n), in SI units. Results have the dtype and the device of x.

    Args:
        problem: the physics.
        mesh: the nodes.
        values: V (steps + 1, N) at the nodes, see `pirl_rl.grid.field.Field`.
        policy: numbers (steps + 1, M) of the best candidates at the nodes outside A and B.
        controls: candidate controls (K, M, m), in SI units.
        nearest: for every node (N,) the place, among the M nodes, of the nearest node outside A and B.
        coarse: the solution with half as many points and steps, or None, and then the error is not known.
        split: whether drift and noise acted in turns, see `pirl_rl.grid.transport`. V is then extrapolated by `SHARE`
            alone, and near faces it is the mean over short paths, see `pirl_rl.grid.faces`.
        unseen: errors (N,) at the nodes, in [0, 1], that the coarse solution cannot show. `error` adds them. None means
            none, and 1 says that the error is not known, as V lies in [0, 1].
    """

    def __init__(
        self,
        problem: ReachAvoidProblem,
        mesh: Mesh,
        values: np.ndarray,
        policy: np.ndarray,
        controls: np.ndarray,
        nearest: np.ndarray,
        coarse: GridSolution | None = None,
        split: bool = False,
        unseen: np.ndarray | None = None,
    ):
        self.problem, self.mesh, self.coarse, self.split = problem, mesh, coarse, split
        self.field, self.unseen = Field(problem, mesh, values), unseen
        self._policy, self._controls, self._nearest = policy, controls, nearest

    dtype, device = torch.float64, torch.device("cpu")
    """The kind of tensors that evaluators pass in, as they do for `pirl_rl.solution.Solution`."""

    @property
    def steps(self) -> int:
        """The number of steps in tau."""
        return len(self.field.values) - 1

    def save(self, path: Path) -> None:
        """Write the solution, without its problem, to one file of numpy arrays.

        Raises:
            OSError: the file cannot be written.
        """
        with replacing(path, binary=True) as file:
            np.savez_compressed(file, allow_pickle=False, **self.arrays())

    @classmethod
    def load(cls, path: Path, problem: ReachAvoidProblem) -> GridSolution:
        """Read the solution of a problem from a file that `save` wrote.

        Raises:
            CheckpointError: the file is missing or broken, or belongs to a problem with other sizes.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = dict(file)
            solution = cls._of(problem, arrays, "")
            solution.coarse = cls._of(problem, arrays, "coarse_") if "coarse_values" in arrays else None
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise CheckpointError(f"{path}: expected the values of a grid, got {error}") from error
        sizes = len(solution.mesh.shape), solution._controls.shape[-1]
        if sizes != (problem.states.dim, problem.controls.dim):
            raise CheckpointError(
                f"{path}: expected {problem.states.dim} states and {problem.controls.dim} controls, "
                f"got {sizes[0]} and {sizes[1]}"
            )
        return solution

    def arrays(self) -> dict[str, np.ndarray]:
        """All numbers that the policy and V are computed from, by name."""
        mesh = self.mesh
        arrays = {
            "origin": mesh.origin,
            "first": mesh.first,
            "spacing": mesh.spacing,
            "shape": np.array(mesh.shape),
            "periodic": np.array(mesh.periodic, int),
            "values": self.field.values,
            "policy": self._policy,
            "controls": self._controls,
            "nearest": self._nearest,
            "split": np.array(self.split),
        }
        if self.unseen is not None:
            arrays["unseen"] = self.unseen
        coarse = {} if self.coarse is None else self.coarse.arrays()
        return arrays | {f"coarse_{name}": array for name, array in coarse.items()}

    @classmethod
    def _of(cls, problem: ReachAvoidProblem, arrays: Mapping[str, np.ndarray], prefix: str) -> GridSolution:
        spacing, shape, periodic = (arrays[prefix + name] for name in ("spacing", "shape", "periodic"))
        values, policy, controls, nearest = (
            arrays[prefix + name] for name in ("values", "policy", "controls", "nearest")
        )
        # Files of earlier versions have the first node alone, as "low", and do not say whether parts acted in turns.
        origin = arrays[f"{prefix}origin" if f"{prefix}origin" in arrays else f"{prefix}low"]
        mesh = Mesh(origin, spacing, shape.tolist(), periodic.tolist(), arrays.get(f"{prefix}first", 0))
        split = bool(arrays.get(f"{prefix}split", False))
        unseen = arrays.get(f"{prefix}unseen")
        return cls(problem, mesh, values, policy, controls, nearest, split=split, unseen=unseen)

    def raw_value(self, tau: Tensor, x: Tensor) -> Tensor:
        """V (P,) as `value` gives it; a grid has no other."""
        return self.value(tau, x)

    def gradient(self, tau: Tensor, x: Tensor) -> Tensor:
        """The gradient of V in x (P, n), per unit of the state, by differences over half a node distance on each side.

        Raises:
            ArgumentError: a tau is outside [0, horizon].
        """
        steps = torch.diag(torch.as_tensor(self.mesh.spacing, dtype=x.dtype, device=x.device)) / 2
        wrap = self.problem.states.wrap
        slopes = [
            (self._between(tau, wrap(x + step)) - self._between(tau, wrap(x - step))) / (2 * step.sum())
            for step in steps
        ]
        return torch.stack(slopes, -1)

    def residual(self, tau: Tensor, x: Tensor) -> Tensor:
        """A grid has no residual between its nodes.

        Raises:
            ArgumentError: always.
        """
        raise ArgumentError(
            "residual: a grid has none between its nodes; its error is that of `solution.error(tau, x)`"
        )

    def value(self, tau: Tensor, x: Tensor) -> Tensor:
        """V (P,) in [0, 1]: 1 in A, 0 in B and in unreachable states.

        With a coarse solution it is extrapolated (L. F. Richardson, Phil. Trans. A 210, 1911), except in the cells of
        the coarse mesh that a face cuts, where the error depends on the place of the face. 2 V_fine - V_coarse removes
        an error that is proportional to the distance of the nodes and the length of the steps. Where drift and noise
        act in turns, the log-odds of V are extrapolated by the `SHARE` of their distance, and V stays between 0 and 1.

        Raises:
            ArgumentError: a tau is outside [0, horizon].
        """
        x = self.problem.states.wrap(x)
        value = self._between(tau, x)
        lost = self.problem.failed(x) | self.problem.unreachable(x)
        return value.clamp(0, 1).masked_fill(self.problem.reached(x), 1.0).masked_fill(lost, 0.0)

    def policy(self, tau: Tensor, x: Tensor) -> Tensor:
        """The control (P, m), in SI units: that of the node with the largest weight in the interpolation of V.

        Controls are not interpolated, since the middle of two good ones may be a bad one, as it is of headings to the
        left and to the right of an obstacle.

        Raises:
            ArgumentError: a tau is outside [0, horizon].
        """
        level, node = self.field.nearest(tau, x)
        place = self._nearest[node]
        return torch.from_numpy(self._controls[self._policy[level, place], place]).to(x)

    def error(self, tau: Tensor, x: Tensor) -> Tensor:
        """An estimate (P,) of the error, see `pirl_rl.grid.estimate`.

        It starts from the distance of V from that with half as many points and steps. The scheme is of first order or
        better, so that the distance is at least about the error of the fine solution, and well above that of the
        extrapolated `value` where the order is 1. What the coarse solution cannot show is added, see `unseen`.

        Raises:
            ArgumentError: the solution was computed without an estimate, or a tau is outside [0, horizon].
        """
        return self._error(tau, self.problem.states.wrap(x), Estimate.__call__)

    def _error(self, tau: Tensor, x: Tensor, part: Callable[[Estimate, Tensor, Tensor], Tensor]) -> Tensor:
        """`error` at states (P, n) within their periods, with the given part of the estimate."""
        if self.coarse is None and self.unseen is None:
            raise ArgumentError("error: expected a solution with an estimate, got one of GridSolver(estimate=False)")
        error = torch.zeros_like(tau, dtype=x.dtype)
        if self.coarse is not None:
            estimate = Estimate(self.field, self.coarse.field, self.split, self.policy, self.gradient)
            error = part(estimate, tau, x)
        if self.unseen is not None:
            nodes, weights = self.mesh.corners(x.detach().double().cpu().numpy())
            error = error + torch.from_numpy((weights * self.unseen[nodes]).sum(0)).to(error)
        return error.clamp(max=1)

    @property
    def largest_error(self) -> float:
        """The largest estimate of the error at tau = horizon and the nodes within `problem.states`, outside A and B.

        The neighbourhood of a node ends at nodes, so that it is left out. The estimate is taken at the horizon,
        since V jumps at tau = 0 on the faces, where no mesh has a small error.
        """
        x = torch.from_numpy(self.mesh.states(self.mesh.indices()))
        x = x[self.problem.states.contains(x) & self.problem.interior(x)]
        tau = torch.full((len(x),), self.problem.horizon, dtype=x.dtype)
        return float(self._error(tau, x, Estimate.at).max())

    def _between(self, tau: Tensor, x: Tensor) -> Tensor:
        """V (P,) between the nodes, extrapolated where no face is near, and continued into A and B."""
        value = self._known(tau, x)
        if self.split:
            near = self.field.near_faces(x) & self.problem.interior(x)
            spacing = torch.as_tensor(self.mesh.spacing).to(x)
            read = self.policy, self._known, self.field.near_faces
            value[near] = mean_beyond_faces(self.problem, spacing, *read, tau[near], x[near])
        return value

    def _known(self, tau: Tensor, x: Tensor) -> Tensor:
        """V (P,) between the nodes, and the payoff where no time is left: V jumps there at the faces of A and B."""
        return torch.where(tau > 0, self._extrapolated(tau, x), self.problem.boundary_value(x).to(x))

    def _extrapolated(self, tau: Tensor, x: Tensor) -> Tensor:
        """V (P,) between the nodes, extrapolated from both solutions in the cells of the coarse one without a face."""
        fine = self.field(tau, x)
        if self.coarse is None:
            return fine
        coarse = self.coarse.field(tau, x)
        if self.split:
            odds, coarse_odds = (value.clamp(SMALLEST, 1 - SMALLEST).logit() for value in (fine, coarse))
            better = (odds + SHARE * (odds - coarse_odds)).sigmoid()
        else:
            better = 2 * fine - coarse
        return torch.where(self.coarse.field.uncut(x), better, fine)
