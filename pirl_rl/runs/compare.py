"""Compare finished runs in one table and one figure, grouped by experiment and method.

    python -m pirl_rl.compare DIR [DIR ...] [--out FOLDER]

    DIR           run directories, or folders that hold them
    --out FOLDER  writes comparison.md and comparison.png there; without it the table is printed alone

Examples:
    python -m pirl_rl.compare runs
    python -m pirl_rl.compare runs/reach1d models/drift --out runs/comparison
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pirl_rl.configuration import PACKAGE
from pirl_rl.errors import RunError
from pirl_rl.figures.comparison import draw_comparison
from pirl_rl.figures.files import save_figures
from pirl_rl.files import replacing
from pirl_rl.loggers import read_metrics
from pirl_rl.progress import helped
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
"""Title of a column, key of summary.json, and statistic over the runs of a group. Columns without any value are left
out."""


class RunRecord(NamedTuple):
    """The data of a finished run.

    Attributes:
        label: its group, "experiment method", with the class of the problem if that is no problem of the package.
        summary: the entries of summary.json.
        metrics: the columns (rows,) of metrics.csv, by name; none where the run logs nothing, as that of a grid.
    """

    label: str
    summary: dict[str, float]
    metrics: dict[str, np.ndarray]

    def get(self, name: str) -> float:
        """An entry of the summary, or NaN if it has none.

        "reward_share" is the reward over the reward of the optimal policy, or the reward itself if that is not known.
        It makes groups comparable whose episodes start from different states.
        """
        if name == "reward_share":
            return self.get("reward") / float(self.summary.get("optimal_reward") or 1.0)
        value = self.summary.get(name)
        return math.nan if value is None else float(value)


def find_runs(folders: Sequence[str | Path]) -> dict[str, list[RunRecord]]:
    """All runs below the folders, by label, in the order of their paths.

    Raises:
        RunError: if there is no run below a folder, or a run cannot be read.
    """
    groups: dict[str, list[RunRecord]] = {}
    paths: dict[Path, None] = {}
    for folder in map(Path, folders):
        found = [path.parent for path in sorted(folder.rglob(str(RunDirectory.SUMMARY)))]
        found = [path for path in found if RunDirectory(path).config.is_file()]
        # The directory of a population has no rows of metrics; its members are the runs.
        held = {parent for path in found for parent in path.parents}
        found = [path for path in found if path not in held or RunDirectory(path).metrics.is_file()]
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
    """Read the data of one run directory.

    Raises:
        RunError: if a file is missing or cannot be read.
    """
    run = RunDirectory(path)
    try:
        config = OmegaConf.load(run.config)
        names = [OmegaConf.select(config, key, throw_on_missing=True) for key in ("experiment_name", "method_name")]
        names[1:1] = _own_problem(config)
        summary = run.numbers()
        metrics = read_metrics(run.metrics) if run.metrics.is_file() else {}
    except (OSError, ValueError, yaml.YAMLError, OmegaConfBaseException) as error:
        raise RunError(f"{path} cannot be read: {error}") from error
    if None in names:
        raise RunError(f"{run.config}: expected the keys experiment_name and method_name")
    return RunRecord(" ".join(map(str, names)), summary, metrics)


def _own_problem(config: Any) -> list[str]:
    """The name of the class of a problem of one's own, if a configuration names it."""
    target = OmegaConf.select(config, "env.problem._target_") or PACKAGE.name
    return [] if target.partition(".")[0] == PACKAGE.name else [target.rpartition(".")[2]]


def comparison_table(groups: dict[str, list[RunRecord]]) -> str:
    """A Markdown table with a row for each group, and a dash where no run of a group has a finite value."""
    runs = [run for group in groups.values() for run in group]
    columns = [column for column in COLUMNS if any(math.isfinite(run.get(column[1])) for run in runs)]
    header = ["group", "seeds", *(title for title, _, _ in columns)]
    lines = [header, ["---", *["---:"] * (len(header) - 1)]]
    for label, runs in groups.items():
        cells = []
        for _, name, statistic in columns:
            values = _finite([run.get(name) for run in runs])
            cells.append(format_metric(name, float(statistic(values))) if len(values) else "-")
        lines.append([label, str(len(runs)), *cells])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _finite(values: Sequence[float]) -> np.ndarray:
    array = np.array(values, dtype=float)
    return array[np.isfinite(array)]


def format_metric(name: str, value: float) -> str:
    """The value of a metric as text, with a number of digits that suits the metric."""
    if name in ("updates", "wall_seconds"):
        return f"{value:.0f}"
    return f"{value:.4f}" if name.startswith(("reward", "fine_success")) else f"{value:.2e}"


def main(arguments: Sequence[str] | None = None) -> None:
    if helped(sys.argv[1:] if arguments is None else arguments, __doc__):
        return
    parser = argparse.ArgumentParser(prog="python -m pirl_rl.compare", add_help=False)
    parser.add_argument("folders", nargs="+", metavar="DIR")
    parser.add_argument("--out", metavar="FOLDER", type=Path)
    options = parser.parse_args(arguments)
    try:
        groups = find_runs(options.folders)
    except RunError as error:
        parser.error(str(error))
    text = comparison_table(groups)
    print(text)
    if options.out is None:
        return
    path = options.out / "comparison.md"
    with replacing(path) as file:
        file.write(text)
    [figure] = save_figures({"comparison": draw_comparison(groups)}, options.out)
    print(f"written  {path}\nfigure   {figure}")
