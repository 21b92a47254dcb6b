"""The machine: the record of how a run was made, one session for each time that it was trained, and its memory."""

from __future__ import annotations

import ctypes
import json
import os
import platform
import shlex
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from pirl_rl.files import replacing
from pirl_rl.run_directory import RunDirectory

PACKAGES = ("pirl_rl", "torch", "torchrl", "tensordict", "numpy")
"""The packages whose versions are recorded."""

TRIM, MAP = -1, -3
"""The numbers of the parameters M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of `mallopt`, a function of the GNU C library."""

LARGEST_KEPT, MOST_KEPT = 2**28, 2**29
"""The size in bytes of the largest arrays whose memory is kept, and the free bytes at the end of the heap that stay."""


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
