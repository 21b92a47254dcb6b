"""How long the default recipe trains until V is as near to the truth as some bounds, beside the time of the grid.

    python benchmarks/time_to_accuracy.py [--problems reach1d zermelo ...] [--seeds 0 1 2] [--every 50] [--states 400]
        [--updates N] [--warm] [--json FILE]

Each run is a process of its own with one thread and an empty cache of compiled programs; with `--warm` a short run of
the same problem has filled the cache, as any earlier run on the machine does. A run trains with the settings of
`+experiment=...` to the end, without evaluations, checkpoints and the check of the problem. After every 50 updates
the mean square of V minus the truth is taken at the same 400 states, while the clocks stand still. A bound is reached
at the first of these updates at which the error is below it.

There are two clocks. The whole time goes from the start of the process, with the imports and all compilation. That of
training goes from the end of the first update, when everything is compiled. Each has the time that has elapsed and, in
parentheses, that of the processor with the processes that compile. Rows have medians over the seeds that reach a bound.

The truth is that of `python -m pirl_rl.suite`: exact, or of a grid. The time of the grid is that of the coarsest one
whose error is below the bound, out of those with 31, 61, 121 and so on nodes along each axis, without imports. A truth
that comes from a grid has 401 nodes in one dimension and 241 in two, and only coarser grids take part.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch

from benchmarks.record import save
from pirl_rl.assembly import make_problem, make_trainer
from pirl_rl.commands.composition import compose
from pirl_rl.commands.suite import STATES_SEED
from pirl_rl.scoring import PROBLEMS, Truth, find_truth, race_grid
from pirl_rl.trainer import Trainer

BOUNDS = (2.6e-3, 1e-3, 1e-4)
"""The bounds of the mean square error of V."""

CHOSEN = ("reach1d", "halfspace-2", "radial_exit-2", "double_integrator", "double_integrator-degenerate")
CHOSEN += ("pendulum", "zermelo")
"""The one-dimensional problem of the paper, and the problems of the suite in two dimensions."""

PLAIN = ("device=cpu", "logger=none", "trainer.evaluate_every=0", "evaluation.during=[]", "evaluation.final=[]")

WARM_UP = 60
"""The number of updates of the run that fills the cache."""

CLOCKS = ("seconds", "processor")


class Clocks:
    """The seconds that have elapsed and those of the processor, without the pauses.

    Args:
        started: `time.monotonic()`, which all processes of a machine share, at the start of this process.
    """

    def __init__(self, started: float):
        self._zero: dict[str, float] = dict(zip(CLOCKS, (started, 0.0), strict=True))

    def read(self) -> dict[str, float]:
        return {name: value - self._zero[name] for name, value in self._now().items()}

    def pause(self, work: Callable[[], Any]) -> Any:
        """Do some work for which the clocks stand still."""
        before = self._now()
        result = work()
        for name, value in self._now().items():
            self._zero[name] += value - before[name]
        return result

    @staticmethod
    def _now() -> dict[str, float]:
        times = os.times()
        processor = times.user + times.system + times.children_user + times.children_system
        return {"seconds": time.monotonic(), "processor": processor}


def train(name: str, settings: list[str], truth: Truth, every: int, started: float) -> dict[str, Any]:
    """Train in this process; returns the error of V by update, and the clocks at the end of the first update.

    Args:
        name: of a problem of the suite.
        settings: those of `python -m pirl_rl.train` beside those of the problem.
        truth: the states at which V is compared, with their values.
        every: the number of updates between measurements.
        started: see `Clocks`.
    """
    clocks = Clocks(started)
    torch.set_num_threads(1)
    trainer = make_trainer(compose("train", [*PROBLEMS[name], *PLAIN, *settings]))
    curve: list[dict[str, float]] = []
    first: dict[str, float] = {}

    def measure(update: int) -> None:
        now = clocks.read()
        curve.append({"update": update, "mse": clocks.pause(lambda: error(trainer, truth)), **now})

    step = trainer.collector.step

    def measured_step(k: int) -> None:
        if k == 1:
            first.update(clocks.read())
        if k and k % every == 0:
            measure(k)
        step(k)

    trainer.collector.step = measured_step  # type: ignore[method-assign]
    trainer.train()
    measure(trainer.update)
    return {"problem": name, "settings": settings, "first update": first, "curve": curve}


def error(trainer: Trainer, truth: Truth) -> float:
    """The mean square of V minus the truth."""
    assert truth.value is not None
    return (trainer.solution.value(truth.tau, truth.x).double() - truth.value).square().mean().item()


def train_apart(name: str, settings: list[str], truth: Truth, every: int, warm: bool) -> dict[str, Any]:
    """`train` in a new process, with an empty cache of compiled programs, or one that a short run has filled."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["TORCHINDUCTOR_CACHE_DIR"] = folder  # the new processes inherit it
        for more in ([f"trainer.updates={WARM_UP}"], []) if warm else ([],):
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                run = pool.submit(train, name, [*settings, *more], truth, every, time.monotonic()).result()
    return run


def reached(run: dict[str, Any], bound: float) -> dict[str, float] | None:
    """The first measured update of a run with an error below a bound, with its times; None where there is none.

    Returns:
        "update" and both clocks since the start of the process, and "training" and "training, processor" since the end
        of the first update.
    """
    for row in run["curve"]:
        if row["mse"] < bound:
            first = run["first update"]
            training = {f"training {name}": row[name] - first[name] for name in CLOCKS}
            return {name: row[name] for name in ("update", *CLOCKS)} | training
    return None


def summarise(name: str, runs: list[dict[str, Any]], truth: Truth) -> list[dict[str, Any]]:
    """The medians over the runs of a problem that reach a bound, and the grid, for each bound."""
    problem, rows = make_problem(compose("train", [*PROBLEMS[name]])), []
    for bound in BOUNDS:
        found = [times for run in runs if (times := reached(run, bound)) is not None]
        medians = {key: statistics.median(times[key] for times in found) for key in found[0]} if found else None
        grid = race_grid(problem, truth, bound)
        rows.append(
            {
                "problem": name,
                "bound": bound,
                "reached": len(found),
                "runs": len(runs),
                "medians": medians,
                "grid": None if grid is None else {key: asdict(grid)[key] for key in (*CLOCKS, "mse")},
            }
        )
    return rows


def show(row: dict[str, Any]) -> str:
    """A row of the table."""
    medians, grid = row["medians"], row["grid"]
    cells = [row["problem"], f"{row['bound']:.1e}", f"{row['reached']} of {row['runs']}"]
    if medians is None:
        cells += [""] * 3
    else:
        cells.append(f"{medians['update']:.0f}")
        cells += [f"{medians[f'{kind}seconds']:.1f} ({medians[f'{kind}processor']:.1f})" for kind in ("", "training ")]
    cells.append("" if grid is None else f"{grid['seconds']:.2f} ({grid['processor']:.2f})")
    return f"| {' | '.join(cells)} |"


def ratios(rows: list[dict[str, Any]]) -> dict[str, float]:
    """The processor time of the grid by the whole one of the recipe, where both reach a bound."""
    return {
        f"processor time until the MSE of V is below {row['bound']:.1e}, {row['problem']}, grid / recipe": row["grid"][
            "processor"
        ]
        / row["medians"]["processor"]
        for row in rows
        if row["grid"] and row["medians"]
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", nargs="+", choices=PROBLEMS, default=[*CHOSEN], metavar="NAME")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--every", type=int, default=50)
    parser.add_argument("--states", type=int, default=400)
    parser.add_argument("--updates", type=int, help="of each run; those of the recipe by default")
    parser.add_argument("--warm", action="store_true", help="fill the cache of compiled programs before each run")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    settings = [] if arguments.updates is None else [f"trainer.updates={arguments.updates}"]
    head = ("problem", "MSE below", "runs", "updates", "whole time, s", "training, s", "grid, s")
    lines, rows, curves = [f"| {' | '.join(head)} |", f"|---|{'--:|' * (len(head) - 1)}"], [], []
    for name in arguments.problems:
        truth = find_truth(make_problem(compose("train", [*PROBLEMS[name]])), arguments.states, STATES_SEED)
        apart = [
            (name, [*settings, f"seed={seed}"], truth, arguments.every, arguments.warm) for seed in arguments.seeds
        ]
        runs = [train_apart(*run) for run in apart]
        curves += runs
        rows += summarise(name, runs, truth)
        save(arguments.json, ratios(rows), rows=rows, runs=curves)
        lines += map(show, rows[-len(BOUNDS) :])
    print("\n".join(lines))


if __name__ == "__main__":
    main()
