"""The layers of actor and critics, in physical units at the input.

Parameters and buffers may have leading axes, over which `forward` broadcasts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from pirl_rl.errors import ArgumentError


class Dense(nn.Linear):
    """x W^T + b (*, N, out) of x (*, N, in); weight (*, out, in) and bias (*, out) may be stacked."""

    def forward(self, input: Tensor) -> Tensor:
        return torch.matmul(input, self.weight.mT) + self.bias.unsqueeze(-2)


class Scaling(nn.Module):
    """The affine map of the box [low, high] to [-1, 1]^d, for inputs (*, N, d).

    As a layer it needs no scaled copy of the physics: derivatives in physical units follow by the chain rule.

    Args:
        low: lower corner, d numbers.
        high: upper corner, d numbers.
    """

    scale: Tensor
    shift: Tensor

    def __init__(self, low: Sequence[float], high: Sequence[float]):
        super().__init__()
        low_, high_ = torch.as_tensor(low, dtype=torch.float64), torch.as_tensor(high, dtype=torch.float64)
        scale = 2 / (high_ - low_)
        self.register_buffer("scale", scale.to(torch.get_default_dtype()))
        self.register_buffer("shift", (-(low_ + high_) / 2 * scale).to(torch.get_default_dtype()))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.scale.unsqueeze(-2) + self.shift.unsqueeze(-2)


class RootTime(nn.Module):
    """Appends sqrt(tau + tau_0) to inputs (*, d) whose first entry is the time to go tau.

    Where the boundary data jump at tau = 0, V varies over a width proportional to sqrt(tau). As a function of the root
    of time that is a wedge, which a small network can represent up to tau = 0.

    Args:
        tau_0: in s, above 0; it bounds the slope 1/(2 sqrt(tau + tau_0)) at tau = 0.
    """

    def __init__(self, tau_0: float):
        super().__init__()
        self.tau_0 = tau_0

    def root(self, tau: Tensor) -> Tensor:
        """sqrt(tau + tau_0) (*), in sqrt(s), of times to go (*)."""
        return torch.sqrt(tau + self.tau_0)

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([x, self.root(x[..., :1])], -1)


class Levels(nn.Module):
    """Appends the k levels of the constraints of A and B to inputs (*, d) that start with (tau, x).

    V changes fastest across the faces of the sets and in layers along them. As functions of the levels these layers are
    functions of one input, which a small network can represent for faces of any shape.

    Args:
        levels: maps states (*, n) to the levels (*, k).
        states: the number n of states.
    """

    def __init__(self, levels: Callable[[Tensor], Tensor], states: int):
        super().__init__()
        self.levels, self.states = levels, states

    def __deepcopy__(self, memo: dict) -> Levels:
        """Copies of a network share the problem, whose levels are then the same function in all of them."""
        return Levels(self.levels, self.states)

    def of(self, x: Tensor) -> Tensor:
        """The states (*, n) in inputs (*, d)."""
        # A view of the inputs cannot be differentiated twice in forward mode by compiled code.
        return x[..., 1 : 1 + self.states].clone()

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([x, self.levels(self.of(x))], -1)


class LogLevels(nn.Module):
    """Appends asinh(l / w) of the last k inputs, which are levels l, for inputs (*, N, d).

    Far from a face this is the logarithm of twice the level over w, with the sign of the level. Beside a face V often
    changes within a layer that is much thinner than the box, as the width sigma^2 / (2 |f|) of a layer against a drift.
    A sigmoid of log l - log b is l / (l + b): as functions of logarithms, layers of any width b have the same slope.

    Args:
        width: w (k,) > 0, in the units of the levels.
    """

    width: Tensor

    def __init__(self, width: Tensor):
        super().__init__()
        self.register_buffer("width", width.to(torch.get_default_dtype()))

    def of(self, z: Tensor) -> Tensor:
        """The levels (*, k) in inputs (*, d)."""
        return z[..., -self.width.shape[-1] :]

    def logs(self, levels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """asinh(l / w) of levels (*, N, k), and its first and second derivatives, likewise."""
        # The ratio has no unit, while powers of levels in small or large units may leave the range of single precision.
        width = self.width.unsqueeze(-2)
        ratio = levels / width
        slope = (1 + ratio.square()).rsqrt()
        return torch.asinh(ratio), slope / width, -ratio * slope**3 / width / width

    def forward(self, z: Tensor) -> Tensor:
        logs = torch.asinh(self.of(z) / self.width.unsqueeze(-2))
        return torch.cat([z.expand(*logs.shape[:-1], -1), logs], -1)


class Periodic(nn.Module):
    """Replaces periodic coordinates by sine and cosine of their angle: (*, N, d) -> (*, N, d + k) for k of them.

    The angle of a coordinate z, in which the period is [-1, 1], is pi (z + 1) = 2 pi (x - low)/(high - low). Its sine
    takes the place of z, and its cosine, the sine of the angle plus pi/2, comes after all other coordinates.

    Args:
        width: the number d of coordinates.
        columns: the k periodic ones among them, counted from 0.
    """

    frequency: Tensor
    phase: Tensor

    def __init__(self, width: int, columns: Sequence[int]):
        super().__init__()
        self.columns = tuple(columns)
        frequency, phase = torch.zeros(2, width + len(columns))
        frequency[[*columns, *range(width, width + len(columns))]] = math.pi
        phase[width:] = math.pi / 2
        self.register_buffer("frequency", frequency)
        self.register_buffer("phase", phase)

    def widened(self, z: Tensor) -> Tensor:
        """The coordinates z (*, d) and once more the periodic ones, (*, d + k)."""
        return torch.cat([z, *(z[..., column : column + 1] for column in self.columns)], -1)

    def waves(self, wide: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The outputs of widened coordinates (*, N, d + k), and their first and second derivatives, likewise."""
        frequency = self.frequency.unsqueeze(-2)
        angle, periodic = frequency * (wide + 1) + self.phase.unsqueeze(-2), frequency > 0
        sine, slope = torch.sin(angle), frequency * torch.cos(angle)
        return (
            torch.where(periodic, sine, wide),
            torch.where(periodic, slope, torch.ones_like(slope)),
            -frequency.square() * sine,
        )

    def forward(self, z: Tensor) -> Tensor:
        return self.waves(self.widened(z))[0]


class Choice(nn.Module):
    """For each of m outputs, that of k numbers evenly spaced over [-1, 1] which has the largest of its k scores.

    With `together` = s > 1, groups of s outputs have one score for each of the k^s combinations of their numbers. The
    layer maps scores (*, m / s * k^s) to (*, m). The output has no gradient in the scores.

    Args:
        choices: the number k, at least 2.
        together: the number s, at least 1.

    Raises:
        ArgumentError: `choices` is no integer of at least 2, or `together` none of at least 1.
    """

    def __init__(self, choices: int, together: int = 1):
        super().__init__()
        for name, number, least in (("choices", choices, 2), ("together", together, 1)):
            if not (isinstance(number, int) and number >= least):
                raise ArgumentError(f"{name}: expected an integer of at least {least}, got {number!r}")
        self.choices, self.together = choices, together

    def forward(self, scores: Tensor) -> Tensor:
        return self.combinations(scores)[self.grouped(scores).argmax(-1)].flatten(-2)

    def grouped(self, scores: Tensor) -> Tensor:
        """The scores (*, m / s * k^s) of all groups as (*, m / s, k^s)."""
        return scores.unflatten(-1, (-1, self.choices**self.together))

    def combinations(self, like: Tensor) -> Tensor:
        """All combinations (k^s, s) of the numbers of one group, with the dtype and the device of a tensor."""
        numbers = torch.linspace(-1, 1, self.choices, dtype=like.dtype, device=like.device)
        return torch.cartesian_prod(*[numbers] * self.together).reshape(-1, self.together)

    def indices(self, numbers: Tensor) -> Tensor:
        """The indices (*, m / s) of the combinations that are nearest to numbers (*, m) in [-1, 1]."""
        places = ((numbers + 1) * ((self.choices - 1) / 2)).round().long().unflatten(-1, (-1, self.together))
        # The last number of a combination changes first.
        return (places * self.choices ** torch.arange(self.together - 1, -1, -1, device=places.device)).sum(-1)


class WindowedChoice(Choice):
    """For each of m outputs, the mean of those of k numbers that lie in one window, by their shares of a softmax.

    The window reaches from a number l_i by w to both sides, and is the one with the largest share. With the shares p_j
    of the numbers l_j, the output is sum_j p_j l_j / sum_j p_j over |l_j - l_i| <= w. It changes smoothly with the
    scores within a window, and jumps where another window takes over. It has no gradient in the scores where it jumps.

    Args:
        choices: the number k, at least 2.
        window: w > 0, in units of the outputs.

    Raises:
        ArgumentError: `choices` is no integer of at least 2, or `window` is not positive.
    """

    def __init__(self, choices: int, window: float):
        super().__init__(choices)
        if not window > 0:
            raise ArgumentError(f"window: expected a number > 0, got {window!r}")
        self.window = window

    def forward(self, scores: Tensor) -> Tensor:
        numbers, share = self.combinations(scores).squeeze(-1), self.grouped(scores).softmax(-1)
        # A little wider than the window, so that rounding does not decide which numbers lie in it.
        wide = self.window + 0.1 / self.choices
        near = ((numbers.unsqueeze(0) - numbers.unsqueeze(1)).abs() <= wide).to(share.dtype)
        mass, moment = share @ near, (share * numbers) @ near
        largest = mass.argmax(-1, keepdim=True)
        return (moment.gather(-1, largest) / mass.gather(-1, largest)).squeeze(-1)
