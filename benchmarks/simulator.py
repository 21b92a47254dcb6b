"""Transitions a second on one thread: `env.step`, and the same through TorchRL's collector.

    python benchmarks/simulator.py [--rounds 20]

Reach1D under u = 1, Brownian bridge, dt = 0.1, physics included; steps start from freshly drawn states, which costs
`env.step` nothing. The collector resets ended episodes itself. Figures are medians over the rounds.
"""

from __future__ import annotations

import argparse
import statistics
import time

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector

from pirl_rl.envs import Reach1DEnv


def push(tau: torch.Tensor) -> torch.Tensor:
    """u = 1."""
    return torch.ones_like(tau)


def flatten(data: TensorDictBase) -> TensorDictBase:
    return data.reshape(-1)


def step_rate(env: Reach1DEnv, steps: int) -> float:
    start = env.reset()
    start["action"] = push(start["tau"])
    env.step(start)
    begin = time.perf_counter()
    for _ in range(steps):
        env.step(start)
    return steps * env.batch_size.numel() / (time.perf_counter() - begin)


def collector_rates(env: Reach1DEnv, frames: int, rounds: int) -> list[float]:
    policy = TensorDictModule(push, in_keys=["tau"], out_keys=["action"])
    collector = Collector(env, policy, frames_per_batch=frames, total_frames=-1, postproc=flatten, track_traj_ids=False)
    rates, iterator = [], iter(collector)
    for _ in range(3):
        next(iterator)
    for _ in range(rounds):
        begin = time.perf_counter()
        next(iterator)
        rates.append(frames / (time.perf_counter() - begin))
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


if __name__ == "__main__":
    main()
