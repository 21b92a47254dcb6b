"""Figures as files.

Figures are drawn without pyplot, so that no display and no global state is needed.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

from pirl_rl.files import replacing

DPI = 110
FIGURES = "figures"
"""Where a run directory keeps them."""


def save_figures(figures: Mapping[str, Figure], folder: str | Path) -> list[Path]:
    """Write figures as PNG files of their names; returns the files."""
    paths = [Path(folder) / f"{name}.png" for name in figures]
    for path, figure in zip(paths, figures.values(), strict=True):
        with replacing(path, binary=True) as file:
            figure.savefig(file, dpi=DPI, format="png", pil_kwargs={"optimize": True})
    return paths
