"""The record of how a run was made: commands, versions and machines, one session for each time that it was trained."""

from __future__ import annotations

import json
import os
import platform
import shlex
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
