"""Transitions per second on one thread, of `env.step` and of TorchRL's collector, and vehicle steps per second.

    python benchmarks/simulator.py [--rounds 20] [--short] [--json FILE]

Reach1D runs under u = 1 with the Brownian bridge and dt = 0.1. Each `env.step` starts from the same states, which a
reset has drawn before; the time of the collector includes the resets of ended episodes. Rates are medians over rounds,
in which eager and compiled steps take turns, and count the time of the processor. `--short` leaves out all but these.

DriftEnv runs at batch 8,192 under delta' = 0 and F_x = 3 kN, with the bridge and dt = 0.1. Its rates are vehicle steps
per second with one integration step in each, and integration steps per second with ten.
"""

from __future__ import annotations

import argparse
import statistics
import time
from pathlib import Path

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector

from benchmarks.record import save
from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.problems.drift.env import DriftEnv
from pirl_rl.problems.reach1d_env import Reach1DEnv


def constant_policy(tau: torch.Tensor) -> torch.Tensor:
    """The control u = 1."""
    return torch.ones_like(tau)


def flatten(data: TensorDictBase) -> TensorDictBase:
    return data.reshape(-1)


def step_rate(env: ReachAvoidEnv, steps: int, action: float = 1.0) -> float:
    start = env.reset()
    start["action"] = torch.full(env.action_spec.shape, action)
    env.step(start)
    started = time.process_time()
    for _ in range(steps):
        env.step(start)
    return steps * env.batch_size.numel() / (time.process_time() - started)


def step_rates(batch: int, rounds: int) -> dict[str, float]:
    """The rates of eager and compiled steps."""
    envs = {
        "eager": Reach1DEnv(num_envs=batch, seed=0),
        "compiled": Reach1DEnv(num_envs=batch, seed=0, compile_simulator=True),
    }
    step_rate(envs["compiled"], 1)
    rates = [{name: step_rate(env, 100) for name, env in envs.items()} for _ in range(rounds)]
    return {name: statistics.median(rate[name] for rate in rates) for name in envs}


def collector_rates(env: Reach1DEnv, frames: int, rounds: int) -> list[float]:
    policy = TensorDictModule(constant_policy, in_keys=["tau"], out_keys=["action"])
    collector = Collector(env, policy, frames_per_batch=frames, total_frames=-1, postproc=flatten, track_traj_ids=False)
    rates, iterator = [], iter(collector)
    for _ in range(3):
        next(iterator)
    for _ in range(rounds):
        started = time.process_time()
        next(iterator)
        rates.append(frames / (time.process_time() - started))
    collector.shutdown()
    return rates


def reach1d(rounds: int, short: bool) -> dict[int, dict[str, float]]:
    """Print and return the rates of Reach1D in transitions a second, by the size of the batch."""
    found = {}
    head = ("batch", "env.step, million/s", "compiled", *(() if short else ("eager, through the collector",)))
    print(f"| {' | '.join(head)} |\n|{'--:|' * len(head)}")
    for batch in (4_096,) if short else (256, 4_096):
        found[batch] = step_rates(batch, rounds)
        if not short:
            env = Reach1DEnv(num_envs=batch, seed=0)
            found[batch]["collector"] = statistics.median(collector_rates(env, 20 * batch, rounds))
        print(f"| {batch:,} | {' | '.join(f'{rate / 1e6:.2f}' for rate in found[batch].values())} |")
    return found


def drift(rounds: int) -> dict[str, float]:
    """Print and return the rates of DriftEnv in steps a second, by what is counted."""
    found = {}
    print("\n| DriftEnv at batch 8,192, one thread | million/s |\n|:--|--:|")
    for substeps, unit in ((1, "vehicle steps, one integration step each"), (10, "integration steps, ten a step")):
        env = DriftEnv(substeps=substeps, num_envs=8_192, seed=0)
        rate = statistics.median(step_rate(env, 20 // substeps, action=0.0) for _ in range(rounds))
        found[unit] = substeps * rate
        print(f"| {unit} | {found[unit] / 1e6:.2f} |")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--short", action="store_true")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print(f"torch {torch.__version__}, 1 thread, medians of {arguments.rounds} rounds\n")
    rates = reach1d(arguments.rounds, arguments.short)
    ratios = {
        f"transitions a second, Reach1D, {batch} paths, compiled / eager": rate["compiled"] / rate["eager"]
        for batch, rate in rates.items()
    }
    save(arguments.json, ratios, reach1d=rates, drift=None if arguments.short else drift(arguments.rounds))


if __name__ == "__main__":
    main()
