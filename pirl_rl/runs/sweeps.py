"""Show a metric over the settings of a sweep, in a table and a figure.

    python -m pirl_rl.sweeps DIR [--metric NAME] [--axes KEY [KEY]] [--out FOLDER]

    DIR            the directory of a sweep
    --metric NAME  a key of summary.json, value_mse by default
    --axes KEY     one or two of the settings that vary
    --out FOLDER   the folder for sweep.md and sweep.png, by default DIR

Examples:
    python -m pirl_rl.sweeps runs/reach1d_sweep/2026-01-31_12-00-00
    python -m pirl_rl.sweeps runs/reach1d_sweep/2026-01-31_12-00-00 --metric success_rate --axes schedule.center
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from matplotlib.figure import Figure
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pirl_rl.errors import RunError
from pirl_rl.figures.files import save_figures
from pirl_rl.figures.sweep import draw_grid, draw_line
from pirl_rl.files import replacing
from pirl_rl.progress import helped
from pirl_rl.run_directory import RunDirectory
from pirl_rl.runs.compare import format_metric, read_run

AVERAGED = "seed"
"""The setting over which the metric is averaged unless it is chosen as an axis."""

UNSET = "default"
"""The value that is shown for a setting in runs whose command line did not have it."""


class SweepJob(NamedTuple):
    """One run of a sweep.

    Attributes:
        settings: the settings on its command line, by key.
        summary: the entries of summary.json; empty if the run failed or has not ended.
    """

    settings: dict[str, str]
    summary: dict[str, float]


class Sweep(NamedTuple):
    """A metric over one or two settings.

    Attributes:
        metric: a key of summary.json.
        axes: the sorted values of each setting, by the setting's name.
        cells: the metric of all runs with the same values of the settings, NaN for a run that failed; combinations
            without a run are absent.
    """

    metric: str
    axes: dict[str, list[str]]
    cells: dict[tuple[str, ...], list[float]]

    def mean(self, cell: tuple[str, ...]) -> float:
        """The mean over the runs of a cell that ended, or NaN if none did."""
        ended = [value for value in self.cells.get(cell, []) if not math.isnan(value)]
        return float(np.mean(ended)) if ended else math.nan

    def text(self, cell: tuple[str, ...]) -> str:
        """The mean of a cell as text, or why there is none."""
        if cell not in self.cells:
            return "missing"
        runs = self.cells[cell]
        failed = sum(map(math.isnan, runs))
        if failed == len(runs):
            return "failed"
        return format_metric(self.metric, self.mean(cell)) + (f" ({failed} of {len(runs)} failed)" if failed else "")


def find_jobs(folder: Path) -> list[SweepJob]:
    """All runs below the directory of a sweep or of a population.

    Raises:
        RunError: if there is no run, or one cannot be read.
    """
    jobs = []
    paths = sorted(folder.rglob(str(RunDirectory.OVERRIDES)))
    for path in paths:
        run = RunDirectory(path.parents[1])
        if any(run.path in other.parents[2:] for other in paths):
            continue  # a population, whose members are the runs
        try:
            typed = OmegaConf.to_container(OmegaConf.load(path))
        except (OSError, ValueError, yaml.YAMLError, OmegaConfBaseException) as error:
            raise RunError(f"{path} cannot be read: {error}") from error
        if not isinstance(typed, list):
            raise RunError(f"{path}: expected a list of overrides, got {type(typed).__name__}")
        settings = {key.lstrip("+~"): _plain(value) for key, _, value in (str(item).partition("=") for item in typed)}
        jobs.append(SweepJob(settings, read_run(run.path).summary if run.summary.is_file() else {}))
    if not jobs:
        raise RunError(f"no runs found below {folder}: expected directories with {RunDirectory.OVERRIDES}")
    return jobs


def _plain(value: str) -> str:
    """Write equal numbers equally, so that 1e4 and 10000.0 are one value of a setting."""
    try:
        return f"{float(value):g}"
    except ValueError:
        return value


def gather(jobs: Sequence[SweepJob], metric: str, axes: Sequence[str] = ()) -> Sweep:
    """Sort runs into the cells of a table; other settings that vary are averaged over.

    Args:
        jobs: the runs.
        metric: a key of summary.json.
        axes: one or two settings; the default is all settings that vary, except the seed.

    Raises:
        RunError: if no run has the metric, a setting is unknown, or there are not one or two axes.
    """
    known = {name for job in jobs for name in job.summary}
    if metric not in known:
        raise RunError(f"metric: expected one of {', '.join(sorted(known)) or '(no run has ended)'}, got {metric}")
    names = dict.fromkeys(name for job in jobs for name in job.settings)
    values = {name: sorted({job.settings.get(name, UNSET) for job in jobs}, key=_order) for name in names}
    varying = [name for name in values if len(values[name]) > 1 and name != AVERAGED]
    chosen = list(axes) or varying
    if unknown := [name for name in chosen if name not in values]:
        raise RunError(f"axes: expected settings out of {', '.join(values)}, got {', '.join(unknown)}")
    if not 1 <= len(chosen) <= 2:
        raise RunError(
            f"axes: expected one or two settings that vary beside the {AVERAGED}, got {len(varying)}"
            + (f": {', '.join(varying)}; choose with --axes, the others are averaged over" if varying else "")
        )
    cells: dict[tuple[str, ...], list[float]] = {}
    for job in jobs:
        cell = tuple(job.settings.get(name, UNSET) for name in chosen)
        cells.setdefault(cell, []).append(float(job.summary.get(metric, math.nan)))
    return Sweep(metric, {name: values[name] for name in chosen}, cells)


def _order(value: str) -> tuple[bool, float, str]:
    """The key by which values are sorted: numbers by size, then words."""
    try:
        return False, float(value), value
    except ValueError:
        return True, 0.0, value


def sweep_table(sweep: Sweep) -> str:
    """A Markdown table with a row for each value of the first setting and a column for each of the second."""
    rows, columns = next(iter(sweep.axes)), dict(list(sweep.axes.items())[1:])
    [(second, values)] = columns.items() or [("", [])]
    lines = [[f"{sweep.metric}: {rows}" + (f" \\ {second}" if second else ""), *(values or ["mean"])]]
    lines.append(["---", *["---:"] * (len(lines[0]) - 1)])
    for value in sweep.axes[rows]:
        cells = [(value, other) for other in values] or [(value,)]
        lines.append([value, *map(sweep.text, cells)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def draw_sweep(sweep: Sweep) -> Figure:
    """A heat map over two settings, or a curve over one."""
    if len(sweep.axes) == 1:
        [(name, values)] = sweep.axes.items()
        return draw_line(sweep.metric, name, {value: sweep.cells.get((value,), []) for value in values})
    (row_name, rows), (column_name, columns) = sweep.axes.items()
    cells = list(itertools.product(rows, columns))
    shape = (len(rows), len(columns))
    means = np.array([sweep.mean(cell) for cell in cells]).reshape(shape)
    texts = np.array([sweep.text(cell).replace(" (", "\n(") for cell in cells]).reshape(shape)
    return draw_grid(sweep.metric, {row_name: rows, column_name: columns}, means, texts)


def main(arguments: Sequence[str] | None = None) -> None:
    if helped(sys.argv[1:] if arguments is None else arguments, __doc__):
        return
    parser = argparse.ArgumentParser(prog="python -m pirl_rl.sweeps", add_help=False)
    parser.add_argument("folder", metavar="DIR", type=Path)
    parser.add_argument("--metric", default="value_mse")
    parser.add_argument("--axes", nargs="+", default=(), metavar="KEY")
    parser.add_argument("--out", metavar="FOLDER", type=Path)
    options = parser.parse_args(arguments)
    try:
        sweep = gather(find_jobs(options.folder), options.metric, options.axes)
    except RunError as error:
        parser.error(str(error))
    out = options.out or options.folder
    path, text = out / "sweep.md", sweep_table(sweep)
    with replacing(path) as file:
        file.write(text)
    [figure] = save_figures({"sweep": draw_sweep(sweep)}, out)
    print(text)
    print(f"written  {path}\nfigure   {figure}")
