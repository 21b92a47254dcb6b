"""Compare finished runs: one table and one figure of all groups of experiment and method.

python -m pirl_rl.compare DIR [DIR ...] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pirl_rl.errors import RunError
from pirl_rl.figures.run import DPI, log_scale, read_metrics
from pirl_rl.run_directory import RunDirectory

LOSSES = ("td_loss", "hjb_loss", "hjb_sup_loss", "boundary_loss")
COLUMNS = (
    ("value_mse mean", "value_mse", np.mean),
    ("value_mse worst", "value_mse", np.max),
    ("reward mean", "reward", np.mean),
    ("reward min", "reward", np.min),
    ("reward / optimal min", "reward_share", np.min),
    ("fine_success mean", "fine_success", np.mean),
    ("fine_success min", "fine_success", np.min),
    ("fine_mse_band mean", "fine_mse_band", np.mean),
    ("fine_mse_band worst", "fine_mse_band", np.max),
    *((name, name, np.mean) for name in (*LOSSES, "value_slope", "updates", "wall_seconds")),
)
"""Column of the table, key of summary.json, statistic over the group's runs; columns that no run has are left out."""

ERRORS = {"value_mse": "MSE against the exact V", "fine_mse_band": "MSE against Monte Carlo, friction inside the band"}
"""What stands for the error of V in the figure: the first that a run has."""


SHARE = "reward / optimal reward, where known"


class RunRecord(NamedTuple):
    """What a finished run left: its group, the numbers of its summary, and the columns of its metrics."""

    label: str
    summary: dict[str, float]
    metrics: dict[str, np.ndarray]

    def get(self, name: str) -> float:
        """A number of the summary, NaN where there is none; "reward_share" is the reward as a fraction of the optimal
        policy's, and the reward itself where that is not known: groups may start and end episodes differently."""
        if name == "reward_share":
            return self.get("reward") / float(self.summary.get("optimal_reward") or 1.0)
        value = self.summary.get(name)
        return math.nan if value is None else float(value)


def find_runs(folders: Sequence[str | Path]) -> dict[str, list[RunRecord]]:
    """All runs below the folders by label, "experiment method", in the order of their paths.

    Raises:
        RunError: no run below a folder, or a run that cannot be read.
    """
    groups: dict[str, list[RunRecord]] = {}
    paths: dict[Path, None] = {}
    for folder in map(Path, folders):
        found = [path.parent for path in sorted(folder.rglob(str(RunDirectory.SUMMARY)))]
        found = [path for path in found if RunDirectory(path).config.is_file()]
        if not found:
            raise RunError(
                f"no runs found below {folder}: expected directories with {RunDirectory.SUMMARY} and "
                f"{RunDirectory.CONFIG}"
            )
        paths |= {path.resolve(): None for path in found}
    for path in paths:
        run = read_run(path)
        groups.setdefault(run.label, []).append(run)
    return groups


def read_run(path: Path) -> RunRecord:
    """Open one run directory.

    Raises:
        RunError: with the file and the reason.
    """
    run = RunDirectory(path)
    try:
        config = OmegaConf.load(run.config)
        names = [OmegaConf.select(config, key, throw_on_missing=True) for key in ("experiment_name", "method_name")]
        summary = json.loads(run.summary.read_text())
        metrics = read_metrics(run.metrics)
    except (OSError, ValueError, OmegaConfBaseException) as error:
        raise RunError(f"{path} cannot be read: {error}") from error
    if None in names:
        raise RunError(f"{run.config}: expected the keys experiment_name and method_name")
    return RunRecord(" ".join(map(str, names)), summary, metrics)


def comparison_table(groups: dict[str, list[RunRecord]]) -> str:
    """A Markdown table, a row for each group; a dash where no run of the group has the number."""
    runs = [run for group in groups.values() for run in group]
    columns = [column for column in COLUMNS if any(math.isfinite(run.get(column[1])) for run in runs)]
    header = ["group", "seeds", *(title for title, _, _ in columns)]
    lines = [header, ["---", *["---:"] * (len(header) - 1)]]
    for label, runs in groups.items():
        cells = []
        for _, name, statistic in columns:
            values = _finite([run.get(name) for run in runs])
            cells.append(number(name, float(statistic(values))) if len(values) else "-")
        lines.append([label, str(len(runs)), *cells])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def draw(groups: dict[str, list[RunRecord]]) -> Figure:
    """Reward and MSE of every run, one against the other, and the held-out losses over training."""
    figure = Figure(figsize=(15, 8), layout="constrained")
    grid = figure.add_gridspec(2, 12)
    reward, mse, both = (figure.add_subplot(grid[0, 4 * i : 4 * i + 4]) for i in range(3))
    _per_seed(reward, groups, "reward_share", "Reward of each seed", SHARE)
    runs = [run for group in groups.values() for run in group]
    name = next((name for name in ERRORS if any(math.isfinite(run.get(name)) for run in runs)), "value_mse")
    _per_seed(mse, groups, name, "MSE of V of each seed", ERRORS[name])
    errors = [run.get(name) for run in runs]
    log_scale(mse, "y", errors)
    log_scale(both, "x", errors)
    _reward_against_mse(both, groups, name)
    for i, name in enumerate(("hjb_loss", "boundary_loss", "td_loss", "hjb_sup_loss")):
        axes = figure.add_subplot(grid[1, 3 * i : 3 * i + 3])
        for color, runs in _colored(groups):
            _evolution(axes, runs, name, color)
        axes.set(title=f"Held-out {name}", xlabel="update", ylabel="mean square" if i == 0 else "")
        log_scale(axes, "y", [value for line in axes.lines for value in line.get_ydata()])  # type: ignore[union-attr]
        axes.grid(alpha=0.3)
    handles, labels = both.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 4))
    return figure


def _per_seed(axes: Axes, groups: dict[str, list[RunRecord]], name: str, title: str, ylabel: str) -> None:
    for i, (color, runs) in enumerate(_colored(groups)):
        values = _finite([run.get(name) for run in runs])
        if len(values):
            spread = np.linspace(-0.25, 0.25, len(values) + 2)[1:-1]
            axes.plot(i + spread, values, "o", ms=4, alpha=0.7, color=color)
            axes.plot([i - 0.35, i + 0.35], [values.mean()] * 2, color=color, lw=2)
    axes.set(title=f"{title}, line: mean", ylabel=ylabel, xlim=(-0.6, len(groups) - 0.4))
    axes.set_xticks(range(len(groups)), list(groups), fontsize="small", rotation=30, ha="right")
    axes.grid(axis="y", alpha=0.3)


def _reward_against_mse(axes: Axes, groups: dict[str, list[RunRecord]], error: str) -> None:
    for label, (color, runs) in zip(groups, _colored(groups), strict=True):
        pairs = np.array([(run.get(error), run.get("reward_share")) for run in runs])
        pairs = pairs[np.isfinite(pairs).all(-1)]
        axes.scatter(*pairs.T, s=14, alpha=0.6, color=color)
        # The empty scatter of a group without exact values still gives the legend its entry.
        mean = pairs.mean(0, keepdims=True) if len(pairs) else pairs
        axes.scatter(*mean.T, s=130, color=color, edgecolors="black", label=label)
    axes.set(title="Reward against MSE, large: mean", xlabel=ERRORS[error], ylabel=SHARE)
    axes.grid(alpha=0.3)


def _evolution(axes: Axes, runs: list[RunRecord], name: str, color: str) -> None:
    """Median and range over runs at every update at which one of them was evaluated."""
    at: dict[float, list[float]] = {}
    for run in runs:
        for update, value in zip(run.metrics.get("update", ()), run.metrics.get(name, ()), strict=False):
            if math.isfinite(value):
                at.setdefault(float(update), []).append(float(value))
    updates = sorted(at)
    axes.plot(updates, [np.median(at[update]) for update in updates], color=color)
    axes.fill_between(
        updates, [min(at[u]) for u in updates], [max(at[u]) for u in updates], color=color, alpha=0.2, lw=0
    )


def _colored(groups: dict[str, list[RunRecord]]) -> list[tuple[str, list[RunRecord]]]:
    return [(f"C{i % 10}", runs) for i, runs in enumerate(groups.values())]


def _finite(values: Sequence[float]) -> np.ndarray:
    array = np.array(values, dtype=float)
    return array[np.isfinite(array)]


def number(name: str, value: float) -> str:
    """A metric as text, with the digits that matter."""
    if name in ("updates", "wall_seconds"):
        return f"{value:.0f}"
    return f"{value:.4f}" if name.startswith(("reward", "fine_success")) else f"{value:.2e}"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m pirl_rl.compare", description="Compare finished runs.")
    parser.add_argument("folders", nargs="+", metavar="DIR", help="run directories, or folders that hold them")
    parser.add_argument(
        "--out", metavar="FOLDER", help="where comparison.md and comparison.png go; default the first DIR"
    )
    options = parser.parse_args(arguments)
    try:
        groups = find_runs(options.folders)
    except RunError as error:
        parser.error(str(error))
    out = Path(options.out or options.folders[0])
    out.mkdir(parents=True, exist_ok=True)
    text = comparison_table(groups)
    (out / "comparison.md").write_text(text)
    draw(groups).savefig(out / "comparison.png", dpi=DPI)
    print(text)
    print(f"Written: {out / 'comparison.md'}, {out / 'comparison.png'}")
