"""The stored ratios of the benchmarks, and the comparison of measured ones with them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

STORED = Path(__file__).with_name("ratios.json")
"""The ratios with which later ones are compared, and the machine on which they were measured."""

WORSE = 1.5
"""How many times smaller than the stored one a ratio is when there is a warning.

Ratios differ between machines, whose caches and compilers differ, and vary where other processes share the caches.
"""


def read(path: Path) -> dict[str, Any]:
    """The record in a file, or one without ratios where there is no such file."""
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {"machine": {}, "ratios": {}}


def compare(measured: Mapping[str, float], stored: Mapping[str, float]) -> list[str]:
    """What is to be said about ratios, in lines: a warning for each that has become worse by more than `WORSE`.

    A last line counts those that are not stored. Nothing is said about a stored ratio that was not measured, as it may
    need a package that is not installed.

    Args:
        measured: the ratios of this run, by name; a larger one is better.
        stored: those with which they are compared.
    """
    both = [name for name in measured if name in stored]
    # A ratio that is not a number is worse too.
    lines = [
        f"warning: {name!r} is {measured[name]:.2f}, and {stored[name]:.2f} is stored. "
        f"It has become worse by more than the factor {WORSE}."
        for name in both
        if not measured[name] * WORSE >= stored[name]
    ] or ["No ratio has become worse."]
    missing = len(measured) - len(both)
    return [*lines, *([f"Ratios that are not stored: {missing} of {len(measured)}."] if missing else [])]


def table(measured: Mapping[str, float], stored: Mapping[str, float]) -> str:
    """The measured ratios beside the stored ones, in Markdown."""
    rows = (f"| {name} | {ratio:.2f} | {_number(stored.get(name))} |" for name, ratio in measured.items())
    return "\n".join(["| ratio | measured | stored |", "|---|--:|--:|", *rows])


def _number(ratio: float | None) -> str:
    return "" if ratio is None else f"{ratio:.2f}"
