"""The source of a subsolution: raised until L^u W >= 0 holds at points between those of the least squares."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from scipy.interpolate import BSpline
from scipy.ndimage import maximum_filter

from pirl_rl.progress import announce
from pirl_rl.proofs.boundary import LOSS
from pirl_rl.proofs.boxes import Boxes
from pirl_rl.proofs.mesh import product
from pirl_rl.proofs.points import Lattice
from pirl_rl.proofs.rates import RatesAt
from pirl_rl.proofs.spline import DEGREE, knots_of
from pirl_rl.proofs.subsolution import Equation

SLACK = 0.3
"""The share of the variation of L^u W within a cell that its least value there is to exceed."""

ENOUGH = 0.75
"""A cell is left alone when it has this share of what the fit aims at."""

RAISE = 1.2
"""The factor by which the source is raised beyond what is missing."""

LARGEST = 2.0
"""The largest size of W outside A and B for which the mesh resolves it; its exact values are between 0 and 1."""

WIDER = 1
"""The number of further cells on each side in which the source is raised for boxes that resist.

In their neighbours alone, as for points, what is missing moves to and fro between cells from round to round.
"""

SHARES = (1.0, 0.3, 0.1, 0.03)
"""The source is raised by the first of these shares for which the mesh resolves W."""

PLACES = (0.0, 1 / 3, 2 / 3, 1.0)
"""Where L^u W is evaluated in each cell along each state."""

TIMES = (0.0, 0.5, 1.0)
"""Where L^u W is evaluated in each cell along tau."""


class Fit:
    """W for a source that is raised where it must be.

    Args:
        equation: gives W for a source.
        rates_at: the control for which L^u W >= 0 is asked.
        margin: where W is not above this, nothing is asked.

    Attributes:
        spline: W.
    """

    def __init__(self, equation: Equation, rates_at: RatesAt, margin: float):
        self.equation, self.mesh, self.margin = equation, equation.mesh, margin
        problem = equation.ends.problem
        axes = self.mesh.points(PLACES)
        self._points = Lattice(problem, self.mesh, axes, self._checked(product(axes)))
        self._rates = rates_at(self._points)
        self._cells = self.mesh.cell_of(self._points.x)
        self._own_cells = self.mesh.cell_of(equation.points.x)
        taus = self.mesh.taus
        self._times = np.unique((taus[:-1, None] + np.diff(taus)[:, None] * np.array(TIMES)).ravel())
        self._least = LOSS / problem.horizon
        self._source = np.full((len(taus), len(equation.points.x)), self._least)
        self.spline = equation.solve(self._source)

    def _checked(self, x: np.ndarray) -> np.ndarray:
        """Which of states (N, n) are outside A and B, or inside in a cell that a face crosses, (N,) bool.

        The latter are left out where W is given in the same cell, since it has a kink there.
        """
        interior = self.equation.ends.problem.interior(torch.from_numpy(x)).numpy()
        crossed, given = np.zeros(self.mesh.cells[1:], bool), np.zeros(self.mesh.cells[1:], bool)
        crossed[self.mesh.cell_of(x[interior])] = True
        cells = self.mesh.cell_of(x)
        np.logical_or.at(given, cells, self.equation.boundary.given(x))
        return interior | (crossed & ~given)[cells]

    def at_points(self, rounds: int) -> None:
        """Raise the source until L^u W is what the fit aims at in all cells, or `rounds` times.

        It ends where the source makes it worse, as on a mesh that is too coarse.
        """
        for number in range(1, rounds + 1):
            announce(f"fitting a bound, round {number}")
            missing = self._missing()
            if not missing.any() or not self._raise_in(missing, DEGREE):
                break

    def on_boxes(self, boxes: Boxes, low: torch.Tensor) -> bool:
        """Raise the source in the cells of boxes (N,) on which a lower bound (N,) of L^u W is negative.

        Returns:
            Whether the source could be raised.
        """
        missing = np.zeros(self.mesh.cells)
        cells = boxes.cell.T[: missing.ndim].numpy()
        np.maximum.at(missing, tuple(cells), (self._least - low).clamp(min=0).numpy())
        return self._raise_in(missing, DEGREE + 2 * WIDER)

    def _raise_in(self, missing: np.ndarray, width: int) -> bool:
        """Raise the source by what is missing in each cell (cells of tau, cells of each state) and those around it.

        Args:
            missing: what is missing.
            width: the number of cells along each state, with that in which it is missing in the middle.

        Returns:
            Whether W is bounded with the raised source; otherwise the source is left as it is.
        """
        around = maximum_filter(missing, size=(1, *[width] * (missing.ndim - 1)), mode="constant")
        padded = np.pad(around, [(1, 1), *[(0, 0)] * (missing.ndim - 1)], mode="edge")
        levels = np.maximum(padded[:-1], padded[1:])
        raised = RAISE * np.stack([level[self._own_cells] for level in levels])
        for share in SHARES:
            source = self._source + share * raised
            spline = self.equation.solve(source)
            coefficients = spline.coefficients.numpy()
            values = self.equation.points.values @ coefficients.reshape(len(coefficients), -1).T
            if np.abs(values).max() <= LARGEST:
                self._source, self.spline = source, spline
                return True
        return False

    def _missing(self) -> np.ndarray:
        """What L^u W lacks in each cell (cells of tau, cells of each state)."""
        least, most = np.full(self.mesh.cells, np.inf), np.full(self.mesh.cells, -np.inf)
        last = self.mesh.cells[0] - 1
        for tau, residual, w in self._residuals():
            asked = w > self.margin
            low, high = np.where(asked, residual, np.inf), np.where(asked, residual, -np.inf)
            # A level of tau belongs to the cells on both of its sides.
            sides = (np.searchsorted(self.mesh.taus, tau, side) - 1 for side in ("left", "right"))
            for k in {min(max(int(side), 0), last) for side in sides}:
                np.minimum.at(least[k], self._cells, low)
                np.maximum.at(most[k], self._cells, high)
        asked = np.isfinite(least)
        wanted = self._least + SLACK * np.where(asked, most - least, 0.0)
        return np.where(asked & (least < ENOUGH * wanted), wanted - least, 0.0)

    def _residuals(self) -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
        """tau, and L^u W (P,) and W (P,) at the points between, for each time."""
        coefficients = self.spline.coefficients.numpy()
        curve = BSpline(knots_of(self.mesh.taus), coefficients.reshape(len(coefficients), -1), DEGREE)
        rate, points = curve.derivative(), self._points
        for tau in self._times:
            derivatives = points.derive(curve(tau))
            moved = np.einsum("kn,kn->n", self._rates(tau, derivatives), derivatives)
            yield tau, moved - points.value(rate(tau)), points.value(curve(tau))
