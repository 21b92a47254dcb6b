"""Time of one state, and distance from the run, of an exported ONNX model, in onnxruntime on one thread.

    python -m pirl_rl.export run=RUN_DIR out=FOLDER format=onnx
    python benchmarks/deployment.py RUN_DIR FOLDER [--calls 20000] [--states 10000]

The time is that of a call from Python with one state; its quantiles are over the calls, each with another state. The
time of the processor leaves out the waits for other processes on a machine that is shared. The distance is the largest
over states, half of them on the faces of A and B: that of V, and those of gradient and control as shares of the largest
gradient and of the width of the control's range. States at which the masks differ, because the level of a state on a
face is rounded to the other side, are counted apart.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import onnxruntime
import torch

from pirl_rl import load_run
from pirl_rl.runs.run import Run
from pirl_rl.sampling.faces import find_faces


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--calls", type=int, default=20_000)
    parser.add_argument("--states", type=int, default=10_000)
    arguments = parser.parse_args()
    run, session = load_run(arguments.run), session_of(arguments.folder / "model.onnx")
    tau, x = points(run, arguments.states)

    names = [output.name for output in session.get_outputs()]
    answer = dict(zip(names, session.run(names, {"tau": tau, "x": x}), strict=True))
    value, gradient, control = run.value(tau, x), run.gradient(tau, x), run.policy(tau, x)
    width = np.subtract(run.problem.controls.high, run.problem.controls.low)
    masked = np.isin(answer["value"], (0, 1)) != np.isin(value, (0, 1))
    print(f"value     {np.abs(answer['value'] - value)[~masked].max():.1e}, and {masked.sum()} masks differ")
    print(f"gradient  {np.abs(answer['gradient'] - gradient).max() / np.abs(gradient).max():.1e} of the largest")
    print(f"control   {(np.abs(answer['control'] - control) / width).max():.1e} of the range")

    wall, busy = np.empty((2, arguments.calls))
    for i in range(arguments.calls):
        k = i % len(x)
        one = {"tau": tau[k : k + 1], "x": x[k : k + 1]}
        started, began = time.perf_counter(), time.thread_time()
        session.run(names, one)
        wall[i], busy[i] = time.perf_counter() - started, time.thread_time() - began
    for name, times in (("elapsed", wall), ("processor", busy)):
        median, high = 1e6 * np.quantile(times[len(times) // 10 :], [0.5, 0.99])
        print(f"{name:<10}{median:.0f} us for one state in the median, {high:.0f} us at the 99th percentile")


if __name__ == "__main__":
    main()
