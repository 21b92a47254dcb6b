"""The machine: the record of how a run was made, and how it keeps memory and multiplies matrices."""

from __future__ import annotations

import ctypes
import functools
import json
import os
import platform
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pirl_rl.files import replacing
from pirl_rl.run_directory import RunDirectory

PACKAGES = ("pirl_rl", "torch", "torchrl", "tensordict", "numpy")
"""The packages whose versions are recorded."""

TRIM, MAP = -1, -3
"""The numbers of the parameters M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of `mallopt`, a function of the GNU C library."""

LARGEST_KEPT, MOST_KEPT = 2**28, 2**29
"""The size in bytes of the largest arrays whose memory is kept, and the free bytes at the end of the heap that stay."""

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


def keep_freed_memory() -> bool:
    """Keep the memory of arrays that are freed, so that the next ones take it over, on Linux.

    The GNU C library gives arrays above 32 MB back to the system when they are freed, and the system fills the pages of
    the next one with zeros. An HJB term with 100 noise channels would spend much of its time on this.

    Returns:
        Whether memory is kept. Other C libraries, and versions of this one that refuse the size, are left as they are.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    # A threshold alone would end the library's own adaptation to the sizes that it sees.
    return mallopt is not None and bool(mallopt(MAP, LARGEST_KEPT)) and bool(mallopt(TRIM, MOST_KEPT))


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


def record_session(run: RunDirectory, arguments: Sequence[str], device: torch.device | str) -> None:
    """Add a session to `.hydra/machine.json`: the command, the time, the versions, and the machine without its name.

    Args:
        run: the run directory, which this process writes into.
        arguments: those of `python -m pirl_rl.train` that make the run, or go on with it.
        device: where the networks are.

    Raises:
        OSError: the file cannot be written.
    """
    sessions = read_sessions(run)
    sessions.append(
        {
            "command": shlex.join(["python", "-m", "pirl_rl.train", *arguments]),
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
            **describe(device),
        }
    )
    with replacing(run.machine) as file:
        file.write(json.dumps({"sessions": sessions}, indent=2) + "\n")


def describe(device: torch.device | str = "cpu") -> dict[str, Any]:
    """The machine without its name, and the versions, as plain values.

    Args:
        device: where the networks are.
    """
    return {
        "device": _name_of(torch.device(device)),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.release()}, {platform.machine()}",
        "python": platform.python_version(),
        **{name: version_of(name) for name in PACKAGES},
    }


def read_sessions(run: RunDirectory) -> list[dict[str, Any]]:
    """The sessions in the order in which they began; none where there is no readable record."""
    try:
        sessions = json.loads(run.machine.read_text(encoding="utf-8"))["sessions"]
    except (OSError, ValueError, KeyError, TypeError):
        return []
    return [entry for entry in sessions if isinstance(entry, dict)] if isinstance(sessions, list) else []


def _name_of(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type


def _processor() -> str:
    """The model of the processor, which Linux alone tells well."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.is_file() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine()


def version_of(package: str) -> str:
    """The version of an installed package."""
    try:
        return version(package)
    except PackageNotFoundError:  # a checkout that is not installed
        return "unknown"
