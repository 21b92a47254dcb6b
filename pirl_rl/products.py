"""Products of matrices on the CPU, by the library that is faster for the sizes of a training."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

ONEDNN: Any = torch.backends.mkldnn
"""The settings of oneDNN, which have their attributes at run time."""

FASTER = 1.2
"""How many times as fast products must be for a change of the library that computes them."""

LESS_EXACT = 10.0
"""How many times as large the rounding errors of such products may be. With bfloat16 they are thousands of times."""

ROUNDS = 15
"""The number of times that products are timed, of which the shortest counts."""

MOST_ROWS = 1_024
"""The largest number of rows of a product that is timed, so that it is over before another process interrupts it."""


@contextmanager
def fast_products(critics: int, rows: int, width: int) -> Iterator[bool]:
    """Let oneDNN multiply matrices of float32 on the CPU, where it is faster than MKL and stays in single precision.

    MKL does not use the AVX-512 units of processors that are not Intel's, and oneDNN does. PyTorch gives products of
    float32 to oneDNN only where bfloat16 is allowed inside of them. Processors with units for matrices of bfloat16
    would take them, and lose digits. All others compute in float32. So products of the given size are timed, and
    compared with double precision. A setting of the user stays as it is.

    Args:
        critics: the number of networks whose matrices are stacked.
        rows: the number of points of a product.
        width: the number of inputs and of outputs of a hidden layer.

    Yields:
        Whether oneDNN multiplies them.
    """
    matmul = ONEDNN.matmul
    before = matmul.fp32_precision
    try:
        chosen = before == "none" and ONEDNN.is_available() and _gains(critics, min(rows, MOST_ROWS), width)
        matmul.fp32_precision = "bf16" if chosen else before
        yield chosen
    finally:
        matmul.fp32_precision = before


@functools.cache
def _gains(critics: int, rows: int, width: int) -> bool:
    """Whether oneDNN is faster than MKL for a layer forward and backward, and stays in single precision."""
    rng, matmul = torch.Generator().manual_seed(0), ONEDNN.matmul
    sizes = ((critics, count, width) for count in (rows, rows, width))
    x, gradient, weight = (torch.randn(size, generator=rng, dtype=torch.float32) for size in sizes)

    def products(x: Tensor, gradient: Tensor, weight: Tensor) -> list[Tensor]:
        return [x @ weight.mT, gradient @ weight, gradient.mT @ x]

    exact = products(x.double(), gradient.double(), weight.double())
    seconds, errors = {}, {}
    for precision in ("none", "bf16"):
        matmul.fp32_precision = precision
        found = products(x, gradient, weight)
        errors[precision] = max(float((a - b).abs().max()) for a, b in zip(found, exact, strict=True))
        seconds[precision] = min(_seconds(lambda: products(x, gradient, weight)) for _ in range(ROUNDS))
    return errors["bf16"] <= LESS_EXACT * errors["none"] and FASTER * seconds["bf16"] <= seconds["none"]


def _seconds(work: Callable[[], object]) -> float:
    started = time.perf_counter()
    work()
    return time.perf_counter() - started
