"""What a benchmark leaves for other programs: its numbers, its ratios and the machine, as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pirl_rl.files import replacing
from pirl_rl.machine import describe


def save(path: Path | None, ratios: Mapping[str, float], device: str = "cpu", **found: Any) -> None:
    """Write the record of a benchmark, unless the path is None.

    Args:
        path: the file; its folder is made if it is not there.
        ratios: quotients of times or of rates that were measured in turns, by name. A larger one is better. They vary
            less from machine to machine than the times themselves.
        device: where the work was done.
        found: everything else that was measured, as plain values.
    """
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as file:
            file.write(json.dumps({"machine": describe(device), "ratios": ratios, **found}, indent=2) + "\n")
