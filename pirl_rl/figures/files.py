"""Figures as PNG files.

Figures are drawn without pyplot, which would need a display and keep global state.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

from pirl_rl.files import replacing

DPI = 110
FIGURES = "figures"
"""The folder of a run directory that holds its figures."""


def save_figures(figures: Mapping[str, Figure], folder: str | Path) -> list[Path]:
    """Write each figure to `<name>.png` in the folder; returns the paths."""
    paths = [Path(folder) / f"{name}.png" for name in figures]
    for path, figure in zip(paths, figures.values(), strict=True):
        with replacing(path, binary=True) as file:
            figure.savefig(file, dpi=DPI, format="png")
    return paths
