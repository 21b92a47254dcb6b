"""Transitions per second on one thread, of `env.step` and of TorchRL's collector, and vehicle steps per second.

    python benchmarks/simulator.py [--rounds 20]

Reach1D runs under u = 1 with the Brownian bridge and dt = 0.1. Each `env.step` starts from the same states, which a
reset has drawn before; the time of the collector includes the resets of ended episodes. Rates are medians over rounds.

DriftEnv runs at batch 8,192 under delta' = 0 and F_x = 3 kN, with the bridge and dt = 0.1. Its rates are vehicle steps
per second with one integration step in each, and integration steps per second with ten.
"""

from __future__ import annotations

import argparse
import statistics
import time

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector

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
    started = time.perf_counter()
    for _ in range(steps):
        env.step(start)
    return steps * env.batch_size.numel() / (time.perf_counter() - started)


def collector_rates(env: Reach1DEnv, frames: int, rounds: int) -> list[float]:
    policy = TensorDictModule(constant_policy, in_keys=["tau"], out_keys=["action"])
    collector = Collector(env, policy, frames_per_batch=frames, total_frames=-1, postproc=flatten, track_traj_ids=False)
    rates, iterator = [], iter(collector)
    for _ in range(3):
        next(iterator)
    for _ in range(rounds):
        started = time.perf_counter()
        next(iterator)
        rates.append(frames / (time.perf_counter() - started))
    collector.shutdown()
    return rates


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20)
    rounds = parser.parse_args().rounds
    torch.set_num_threads(1)
    print(f"torch {torch.__version__}, 1 thread, medians of {rounds} rounds\n")
    print("| batch | env.step, million/s | through the collector, million/s |")
    print("|--:|--:|--:|")
    for batch in (256, 4_096):
        env = Reach1DEnv(num_envs=batch, seed=0)
        stepped = statistics.median(step_rate(env, 100) for _ in range(rounds)) / 1e6
        collected = statistics.median(collector_rates(env, 20 * batch, rounds)) / 1e6
        print(f"| {batch:,} | {stepped:.2f} | {collected:.2f} |")
    print("\n| DriftEnv at batch 8,192, one thread | million/s |")
    print("|:--|--:|")
    for substeps, unit in ((1, "vehicle steps, one integration step each"), (10, "integration steps, ten a step")):
        env = DriftEnv(substeps=substeps, num_envs=8_192, seed=0)
        rate = statistics.median(step_rate(env, 20 // substeps, action=0.0) for _ in range(rounds))
        print(f"| {unit} | {substeps * rate / 1e6:.2f} |")


if __name__ == "__main__":
    main()
