"""The functions of torch that join, divide and shape tensors, for affine forms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from pirl_rl.proofs.affine import FUNCTIONS, Affine


def _join(join: Callable[..., Tensor]) -> Callable[..., Affine]:
    def joined(parts: Sequence[Affine | Tensor], dim: int = 0) -> Affine:
        like = next(part for part in parts if isinstance(part, Affine))
        forms = [Affine.of(part, like) for part in parts]
        ndim = like.ndim + (join is torch.stack)
        dim = dim if dim < 0 else dim - ndim
        shape = like.shape if join is torch.stack else None
        entries = [(form.centre, form.slopes, form.radius) for form in forms]
        if shape is not None:
            entries = [(c.expand(shape), s.expand(len(s), *shape), r.expand(shape)) for c, s, r in entries]
        return Affine(*(join(part, dim) for part in zip(*entries, strict=True)))

    return joined


def unbind(z: Affine, dim: int = 0) -> list[Affine]:
    dim = dim if dim < 0 else dim - z.ndim
    return [Affine(*parts) for parts in zip(*(e.unbind(dim) for e in (z.centre, z.slopes, z.radius)), strict=True)]


def unsqueeze(z: Affine, dim: int) -> Affine:
    dim = dim if dim < 0 else dim - z.ndim - 1
    return Affine(*(entry.unsqueeze(dim) for entry in (z.centre, z.slopes, z.radius)))


def _expand(z: Affine, *shape: Any) -> Affine:
    sizes = tuple(shape[0]) if len(shape) == 1 and isinstance(shape[0], (tuple, list, torch.Size)) else shape
    return Affine(z.centre.expand(sizes), z.slopes.expand(len(z.slopes), *sizes), z.radius.expand(sizes))


def _like(make: Callable[..., Tensor]) -> Callable[..., Tensor]:
    return lambda z, **_: make(z.centre)


def _filled(z: Affine, value: float, **_: Any) -> Tensor:
    return torch.full_like(z.centre, value)


def _to(value: Any, *_: Any, **__: Any) -> Any:
    """Forms are double precision on the CPU; a tensor that is moved to the kind of a form becomes that too."""
    return value if isinstance(value, Affine) else value.to("cpu", torch.float64)


FUNCTIONS.update(
    {
        "cat": _join(torch.cat),
        "concat": _join(torch.cat),
        "stack": _join(torch.stack),
        "unbind": unbind,
        "unsqueeze": unsqueeze,
        "squeeze": lambda z, dim: z.map(lambda entry: entry.squeeze(dim)),
        "expand": _expand,
        "clone": lambda z: z,
        "detach": lambda z: z,
        "double": lambda z: z,
        "to": _to,
        "ones_like": _like(torch.ones_like),
        "zeros_like": _like(torch.zeros_like),
        "full_like": _filled,
        "new_ones": lambda z, *shape, **_: torch.ones(*shape, dtype=torch.float64),
        "new_full": lambda z, shape, value, **_: torch.full(shape, value, dtype=torch.float64),
    }
)
