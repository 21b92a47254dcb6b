"""Time of one state, and distance from the run, of exported ONNX models, in onnxruntime on one thread.

    python -m pirl_rl.export run=RUN_DIR out=FOLDER format=onnx
    python benchmarks/deployment.py [RUN_DIR FOLDER ...] [--calls 30000] [--states 10000] [--json FILE]

Without a run directory and the folder of its model, it exports the drifting car of `models/drift` and takes that.

The time is that of a call from Python with one state; its quantiles are over the calls, each with another state. Models
take turns, in blocks of 500 calls, so that all of them see the same machine. The time of the processor leaves out the
waits for other processes on a machine that is shared, but not the cold caches that these leave behind; the quietest
block, the one with the lowest 99th percentile, shows the model alone.

The distance is the largest over states, half of them on the faces of A and B: that of V, and those of gradient and
control as shares of the largest gradient and of the width of the control's range. States at which the masks differ,
because the level of a state on a face is rounded to the other side, are counted apart.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnxruntime
import torch

from benchmarks.record import save
from pirl_rl import load_run
from pirl_rl.commands.export import main as export
from pirl_rl.runs.run import Run
from pirl_rl.sampling.faces import find_faces

BLOCK = 500

CAR = Path(__file__).parents[1] / "models" / "drift"
"""The run that is measured where none is given."""


class Model(NamedTuple):
    """A session, and times to go (N,) and states (N, n) to evaluate."""

    folder: Path
    session: onnxruntime.InferenceSession
    tau: np.ndarray
    x: np.ndarray

    @property
    def outputs(self) -> list[str]:
        return [output.name for output in self.session.get_outputs()]

    def block(self) -> np.ndarray:
        """Elapsed and processor times (BLOCK, 2) of calls with one state each, in microseconds."""
        times, names = np.empty((BLOCK, 2)), self.outputs
        for i in range(BLOCK):
            one = {"tau": self.tau[i : i + 1], "x": self.x[i : i + 1]}
            started, began = time.perf_counter(), time.thread_time()
            self.session.run(names, one)
            times[i] = time.perf_counter() - started, time.thread_time() - began
        return 1e6 * times


def session_of(model: Path) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


def points(run: Run, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Times to go (N,) and states (N, n)."""
    rng = torch.Generator().manual_seed(0)
    faces = find_faces(run.problem, rng).points
    faces = faces[torch.randperm(len(faces), generator=rng)[: count // 2]]
    x = torch.cat([faces, run.problem.states.sample(count - len(faces), rng)])
    return (run.problem.horizon * torch.rand(count, generator=rng)).numpy(), x.numpy()


def compare(model: Model, run: Run) -> dict[str, float]:
    """Print and return how far the numbers of a model are from those of its run."""
    tau, x = model.tau, model.x
    answer = dict(zip(model.outputs, model.session.run(model.outputs, {"tau": tau, "x": x}), strict=True))
    value, gradient, control = run.value(tau, x), run.gradient(tau, x), run.policy(tau, x)
    width = np.subtract(run.problem.controls.high, run.problem.controls.low)
    masked = np.isin(np.asarray(answer["value"]), (0, 1)) != np.isin(value, (0, 1))
    distance = {
        "value": float(np.abs(answer["value"] - value)[~masked].max()),
        "masks": float(masked.sum()),
        "gradient": float(np.abs(answer["gradient"] - gradient).max() / np.abs(gradient).max()),
        "control": float((np.abs(answer["control"] - control) / width).max()),
    }
    print(f"{model.folder}")
    print(f"  value     {distance['value']:.1e}, and {distance['masks']:.0f} masks differ")
    print(f"  gradient  {distance['gradient']:.1e} of the largest")
    print(f"  control   {distance['control']:.1e} of the range")
    return distance


def measure(pairs: list[tuple[Path, Path]], calls: int, states: int) -> list[dict[str, Any]]:
    """Print and return the distances and the times of models.

    Args:
        pairs: run directories, and the folders of their models.
        calls: the number of timed calls of each model.
        states: the number of states at which a model is compared with its run.
    """
    models, rows = [], []
    for place, folder in pairs:
        run = load_run(place)
        models.append(Model(folder, session_of(folder / "model.onnx"), *points(run, states)))
        rows.append({"run": str(place), "distance": compare(models[-1], run)})
    rounds = [[model.block() for model in models] for _ in range(1 + calls // BLOCK)][1:]
    for model, row, blocks in zip(models, rows, np.array(rounds).swapaxes(0, 1), strict=True):
        print(f"{model.folder}, microseconds for one state")
        for name, times in zip(("elapsed", "processor"), np.moveaxis(blocks, -1, 0), strict=True):
            quiet = times[np.quantile(times, 0.99, axis=1).argmin()]
            quantiles = [*np.quantile(times, [0.5, 0.99]).tolist(), *np.quantile(quiet, [0.5, 0.99]).tolist()]
            row[name] = dict(zip(("median", "99 %", "quiet median", "quiet 99 %"), quantiles, strict=True))
            print(
                f"  {name:<10}median {quantiles[0]:.0f}, 99th percentile {quantiles[1]:.0f}; in the quietest block "
                f"{quantiles[2]:.0f} and {quantiles[3]:.0f}"
            )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pairs", type=Path, nargs="*", metavar="RUN_DIR FOLDER")
    parser.add_argument("--calls", type=int, default=30_000)
    parser.add_argument("--states", type=int, default=10_000)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    pairs = [*zip(arguments.pairs[::2], arguments.pairs[1::2], strict=True)]
    with tempfile.TemporaryDirectory() as folder:
        if not pairs:
            pairs.append((CAR, Path(folder) / CAR.name))
            export([f"run={CAR}", f"out={pairs[0][1]}", "format=onnx"])
        save(arguments.json, {}, rows=measure(pairs, arguments.calls, arguments.states))


if __name__ == "__main__":
    main()
