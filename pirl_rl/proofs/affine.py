"""Affine arithmetic: enclosures of functions over boxes, which hold in spite of rounding.

A number that depends on the point z of a box is enclosed by an affine form of the box's coordinates e in [-1, 1]^d,

    z(e) = centre + sum_i slope_i e_i + error,    |error| <= radius,

after J. L. D. Comba and J. Stolfi, SIBGRAPI 1993, with one term for each coordinate and one for all that is not linear.
The enclosure of a smooth function is wrong by the square of the box's size, where an interval is by the size itself.

Forms go through functions that are written for tensors, such as the drift of a problem or the layers of a network,
since they answer the calls of torch's functions (`__torch_function__`). A function that is not known is refused.

Rounding: each operation widens the radius by a bound of its own rounding errors. Sums and products of doubles are
exact to `ROUNDING` of the magnitudes that enter. Elementary functions of torch are taken to be exact to eight times
that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from pirl_rl.errors import ProofError

ROUNDING = 2.0**-52
"""Twice the relative error of one operation of doubles."""

Number = float | int | Tensor

FUNCTIONS: dict[str, Callable[..., Any]] = {}
"""The enclosures of torch's functions by their names, with torch's arguments; see `functions` and `structure`."""


class Affine:
    """Affine forms of shape (N, *), one for each of N boxes and each entry.

    Args:
        centre: (N, *), float64.
        slopes: (d, N, *), the change of the form along half a side of the box.
        radius: (N, *), >= 0.
    """

    def __init__(self, centre: Tensor, slopes: Tensor, radius: Tensor):
        self.centre, self.slopes, self.radius = centre, slopes, radius

    @classmethod
    def of_box(cls, centre: Tensor, half_width: Tensor) -> Affine:
        """The coordinates (N, d) of points of N boxes with centres (N, d) and halves of their sides (N, d)."""
        slopes = torch.diag_embed(half_width).movedim(1, 0)
        return cls(centre, slopes, ROUNDING * (centre.abs() + half_width))

    @classmethod
    def of(cls, value: Affine | Number, like: Affine) -> Affine:
        """The value itself if it is a form; else forms with this exact value, which broadcasts to (N, *).

        Args:
            value: a form, a number, or a tensor.
            like: forms of the same boxes.
        """
        if isinstance(value, Affine):
            return value
        value = torch.as_tensor(value, dtype=torch.float64)
        return cls(value, value.new_zeros((len(like.slopes), *value.shape)), torch.zeros_like(value))

    # Bounds

    @property
    def spread(self) -> Tensor:
        """The largest distance (N, *) from the centre."""
        return self.slopes.abs().sum(0) + self.radius

    @property
    def magnitude(self) -> Tensor:
        """A bound (N, *) of the absolute value."""
        return self.centre.abs() + self.spread

    @property
    def low(self) -> Tensor:
        """A lower bound (N, *)."""
        return self.centre - self.spread - self._slack

    @property
    def high(self) -> Tensor:
        """An upper bound (N, *)."""
        return self.centre + self.spread + self._slack

    @property
    def _slack(self) -> Tensor:
        """A bound (N, *) of the rounding errors of the sums in `spread`, `low` and `high`."""
        return (len(self.slopes) + 4) * ROUNDING * self.magnitude

    # Structure, as of a tensor of shape (N, *)

    @property
    def shape(self) -> torch.Size:
        return self.centre.shape

    @property
    def ndim(self) -> int:
        return self.centre.ndim

    @property
    def dtype(self) -> torch.dtype:
        return self.centre.dtype

    @property
    def device(self) -> torch.device:
        return self.centre.device

    def __len__(self) -> int:
        return len(self.centre)

    def new_tensor(self, data: Any, **_: Any) -> Tensor:
        return torch.as_tensor(data, dtype=torch.float64)

    def new_zeros(self, *shape: Any, **_: Any) -> Tensor:
        return torch.zeros(*shape, dtype=torch.float64)

    def map(self, change: Callable[[Tensor], Tensor]) -> Affine:
        """The forms after a change of shape that leaves the leading axis where it is."""
        return Affine(change(self.centre), torch.vmap(change)(self.slopes), change(self.radius))

    def __getitem__(self, index: Any) -> Affine:
        return self.map(lambda entry: entry[index])

    def __getattr__(self, name: str) -> Any:
        """The methods of tensors are torch's functions of the same name."""
        function = getattr(torch.Tensor, name, None) if not name.startswith("_") else None
        if function is None:
            raise AttributeError(name)
        if not callable(function):
            raise ProofError(_unknown(name))
        return lambda *args, **kwargs: self.__torch_function__(function, (), (self, *args), kwargs)

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Any = None) -> Any:
        name = getattr(func, "__name__", str(func))
        # Functions such as add_ change their argument in place, which forms cannot.
        name = name.strip("_") if name.startswith("_") else name
        if name not in FUNCTIONS:
            raise ProofError(_unknown(name))
        try:
            return FUNCTIONS[name](*args, **(kwargs or {}))
        except TypeError as error:
            raise ProofError(
                f"torch.{name}: no enclosure is known with these arguments, so that nothing can be proved: {error}"
            ) from error

    def __bool__(self) -> bool:
        raise ProofError("if: a branch on states or controls has no enclosure; torch.where has one")

    def __array_ufunc__(self, function: Any, _: str, *args: Any, **kwargs: Any) -> Any:
        """Numpy's functions, also the products with its numbers, are torch's functions of the same name."""
        return self.__torch_function__(function, (), args, kwargs)

    # Arithmetic

    def _plus(self, other: Affine | Number, sign: float) -> Affine:
        other = Affine.of(other, self)
        centre = self.centre + sign * other.centre
        own, others = torch.broadcast_tensors(_padded(self.slopes, centre.ndim), _padded(other.slopes, centre.ndim))
        slopes = own + sign * others
        magnitude = self.magnitude + other.magnitude
        return Affine(centre, slopes, self.radius + other.radius + 2 * ROUNDING * magnitude)

    def __add__(self, other: Affine | Number) -> Affine:
        return self._plus(other, 1.0)

    def __sub__(self, other: Affine | Number) -> Affine:
        return self._plus(other, -1.0)

    def __rsub__(self, other: Number) -> Affine:
        return (-self)._plus(other, 1.0)

    def __neg__(self) -> Affine:
        return Affine(-self.centre, -self.slopes, self.radius)

    def __mul__(self, other: Affine | Number) -> Affine:
        if not isinstance(other, Affine):
            other = torch.as_tensor(other, dtype=torch.float64)
            radius = (self.radius + 2 * ROUNDING * self.magnitude) * other.abs()
            return Affine(self.centre * other, self.slopes * other, radius)
        ndim = max(self.ndim, other.ndim)
        own, others = _padded(self.slopes, ndim), _padded(other.slopes, ndim)
        slopes = self.centre * others + other.centre * own
        spreads = own.abs().sum(0), others.abs().sum(0)
        # The products of slopes e_i e_j, and all products with a radius.
        radius = spreads[0] * spreads[1] + self.radius * (other.centre.abs() + spreads[1] + other.radius)
        radius = radius + other.radius * (self.centre.abs() + spreads[0])
        return Affine(self.centre * other.centre, slopes, radius + 8 * ROUNDING * self.magnitude * other.magnitude)

    __radd__, __rmul__ = __add__, __mul__

    def __truediv__(self, other: Affine | Number) -> Affine:
        if isinstance(other, Affine):
            return self * other.reciprocal()
        return self * (1 / torch.as_tensor(other, dtype=torch.float64))

    def __rtruediv__(self, other: Number) -> Affine:
        return self.reciprocal() * other

    def __pow__(self, exponent: float) -> Affine:
        if exponent == 0.5:
            return self.sqrt()
        if not (isinstance(exponent, (int, float)) and exponent >= 1 and exponent == int(exponent)):
            raise ProofError(f"**: expected the power 0.5 or an integer power >= 1, got {exponent!r}")
        exponent = int(exponent)
        half = self ** (exponent // 2) if exponent > 1 else self
        if exponent == 1:
            return self
        return half.square() if exponent % 2 == 0 else half.square() * self

    def smooth(
        self,
        function: Callable[[Tensor], Tensor],
        slope: Callable[[Tensor], Tensor],
        curvature: Callable[[Tensor, Tensor], Tensor],
        monotone: bool = False,
    ) -> Affine:
        """A function of the forms by its tangent: |phi(z) - phi(c) - phi'(c) (z - c)| <= max |phi''| (z - c)^2 / 2.

        Args:
            function: phi.
            slope: phi'.
            curvature: a bound of |phi''| over intervals, from their lower and their upper ends.
            monotone: whether phi never falls, so that its values at both ends enclose it too.
        """
        value, slope_ = function(self.centre), slope(self.centre)
        spread, low, high = self.spread + self._slack, self.low, self.high
        radius = slope_.abs() * self.radius + curvature(low, high) * spread.square() / 2
        rounding = 8 * ROUNDING * (value.abs() + slope_.abs() * self.magnitude)
        result = Affine(value, slope_ * self.slopes, radius + rounding)
        if not monotone:
            return result
        least, most = function(low), function(high)
        middle, half = (least + most) / 2, (most - least) / 2 + 8 * ROUNDING * (least.abs() + most.abs())
        return result.where(result.radius <= half, Affine(middle, torch.zeros_like(result.slopes), half))

    def where(self, condition: Tensor, other: Affine | Number) -> Affine:
        """These forms where the condition holds, and the others elsewhere."""
        other = Affine.of(other, self)
        ndim = max(condition.ndim, self.ndim, other.ndim)
        slopes = _padded(self.slopes, ndim), _padded(other.slopes, ndim)
        parts = ((self.centre, other.centre), slopes, (self.radius, other.radius))
        return Affine(*(torch.where(condition, a, b) for a, b in parts))

    def matmul(self, matrix: Tensor) -> Affine:
        """The product (N, *, k) of forms (N, *, l) with a matrix (l, k), or (N, *) with a vector (l,)."""
        if isinstance(matrix, Affine):
            raise ProofError("matmul: the product of two matrices that both depend on the state has no enclosure")
        if matrix.ndim == 1:
            return self.matmul(matrix.unsqueeze(-1))[..., 0]
        matrix = matrix.to(torch.float64)
        size = matrix.abs()
        terms = (matrix.shape[-2] + 4) * ROUNDING
        radius = self.radius @ size + terms * (self.magnitude @ size)
        return Affine(self.centre @ matrix, self.slopes @ matrix, radius)

    __matmul__ = matmul

    def total(self, dim: int = -1, keepdim: bool = False) -> Affine:
        """The sum over an axis other than the leading one, counted from the end."""
        if dim >= 0:
            dim -= self.ndim
        terms = self.shape[dim] * ROUNDING * self.magnitude.sum(dim, keepdim=keepdim)
        return Affine(
            self.centre.sum(dim, keepdim=keepdim),
            self.slopes.sum(dim, keepdim=keepdim),
            self.radius.sum(dim, keepdim=keepdim) + terms,
        )


def _operator(name: str) -> Callable[..., Any]:
    """An operator of Python, which is that of torch's tensors."""
    function = getattr(torch.Tensor, name)
    return lambda *args: Affine.__torch_function__(function, (), args)


# Among them are those that have no enclosure. Python would give some of them a meaning of its own: without __eq__, for
# instance, x == 0 is False.
for _name in (
    *("abs", "pos", "eq", "ne", "lt", "le", "gt", "ge", "and", "or", "invert", "mod", "rmod", "floordiv", "rfloordiv"),
    *("rpow", "iter", "setitem", "array", "float", "int", "index"),
):
    setattr(Affine, f"__{_name}__", _operator(f"__{_name}__"))


def _unknown(name: str) -> str:
    """What is said about a function of torch that has no enclosure."""
    return (
        f"torch.{name}: no enclosure of this function is known, so that nothing can be proved; those of "
        f"{', '.join(sorted(FUNCTIONS))} are"
    )


def _padded(slopes: Tensor, ndim: int) -> Tensor:
    """Slopes (d, N, *) with axes of length 1 after the first, so that they broadcast like forms with `ndim` axes."""
    return slopes.reshape(len(slopes), *[1] * (ndim + 1 - slopes.ndim), *slopes.shape[1:])
