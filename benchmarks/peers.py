"""TD3 against Stable-Baselines3 and against TorchRL's own loop: updates a second, and played steps a second.

    python benchmarks/peers.py [--rounds 20] [--updates 50] [--json FILE]

An update draws a batch from the replay buffer, takes a step of Adam for two critics and, every second time, one for the
actor and one of the target networks. Widths, batch size, and rates are equal; widths and batch size are those of the
paper for each problem. TorchRL's loop is that of its TD3 script: `TD3Loss`, `SoftUpdate` and Adam, run eagerly. "matrix
products" are those of an update alone, forward and backward, without activations, samplers and optimisers: the floor of
this machine for everything that runs through torch.

A played step is one control step of one path, with its policy, noise and storage in the replay buffer.
Stable-Baselines3 plays the Gymnasium view of the same problem: one environment, which is its default, or 64 paths of
the vector environment. The variants take turns, and rates are medians over the rounds.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from stable_baselines3 import TD3
from stable_baselines3.common.noise import NormalActionNoise
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate, TD3Loss

from benchmarks.learner import MatrixProducts, Shape
from benchmarks.record import save
from pirl_rl.assembly import make_trainer
from pirl_rl.collectors.sync import SyncCollector
from pirl_rl.commands.composition import compose
from pirl_rl.envs import ReachAvoidEnv
from pirl_rl.gymnasium import ReachAvoidVectorGym
from pirl_rl.rivals.stable_baselines import Paths
from pirl_rl.trainer import Trainer


@dataclass(frozen=True)
class Case:
    """A problem with the paper's widths of hidden layers and transitions of an update.

    Attributes:
        experiment: the name of its experiment.
        critic: the widths of the hidden layers of the critics.
        batch: the number of transitions of an update.
        actor: the widths of the hidden layers of the actor.
    """

    experiment: str
    critic: tuple[int, ...]
    batch: int
    actor: tuple[int, ...] = (32, 32)


CASES = {
    "the 1-D problem": Case("reach1d", (32, 32, 32), 128),
    "the drifting vehicle": Case("drift", (64, 64, 64), 256),
}

OURS = {"updates a second": "pirl_rl", "played steps a second": "pirl_rl, collector"}
"""The rate of ours that the others are compared with; theirs have policy, noise and storage too."""

SETTINGS = (
    "method=td3",
    "recipe=any_problem",
    "device=cpu",
    "logger=none",
    "learner={learning_rate:1e-3,decay:constant,optimizer:adam,polyak:0.005}",
    "collector.control_variate=null",
    "trainer.updates=1000",
)


def ours(case: Case) -> Trainer:
    """Our trainer of TD3, with a full replay buffer."""
    sizes = [
        f"actor={{hidden:{[*case.actor]},activation:ReLU,root_time:false,spread:null,levels:false}}",
        f"critic={{hidden:{[*case.critic]},activation:Tanh,output:null,root_time:false,spread:null,levels:false,"
        "log_levels:false}",
        f"trainer.batch_size={case.batch}",
    ]
    trainer = make_trainer(compose("train", [f"+experiment={case.experiment}", *SETTINGS, *sizes]))
    trainer._enter_stage()
    trainer.collector.start()
    return trainer


def update_ours(trainer: Trainer) -> Callable[[int], None]:
    def updates(count: int) -> None:
        with trainer.products():
            for k in range(count):
                batch = trainer.batches.sample((1.0, 0.0, 0.0), 0.0)
                trainer.learner.update(batch, k, (1.0, 0.0, 0.0), 0.0)

    return updates


class Perceptron(nn.Sequential):
    """A multilayer perceptron of the joined inputs."""

    def __init__(self, widths: tuple[int, ...], activation: type[nn.Module], *last: nn.Module):
        layers: list[nn.Module] = []
        for width, following in itertools.pairwise(widths[:-1]):
            layers += [nn.Linear(width, following), activation()]
        super().__init__(*layers, nn.Linear(widths[-2], widths[-1]), *last)

    def forward(self, *inputs: Tensor) -> Tensor:
        return super().forward(torch.cat(inputs, -1))


def update_torchrl(trainer: Trainer, case: Case) -> Callable[[int], None]:
    """TorchRL's own loop on the transitions of our buffer."""
    problem = trainer.learner.loss.problem
    n, m = problem.states.dim, problem.controls.dim
    actor = TensorDictModule(Perceptron((1 + n, *case.actor, m), nn.ReLU, nn.Tanh()), ["tau", "state"], ["action"])
    critic = TensorDictModule(
        Perceptron((1 + n + m, *case.critic, 1), nn.Tanh), ["tau", "state", "action"], ["state_action_value"]
    )
    bounds = (-torch.ones(m), torch.ones(m))
    loss = TD3Loss(actor, critic, bounds=bounds, num_qvalue_nets=2, loss_function="l2")  # type: ignore[arg-type]
    loss.make_value_estimator(gamma=1.0)
    targets = SoftUpdate(loss, tau=0.005)
    critic_adam = torch.optim.Adam(loss.qvalue_network_params.parameters(), 1e-3)
    actor_adam = torch.optim.Adam(loss.actor_network_params.parameters(), 1e-3)
    transitions = trainer.collector.buffer[:]
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(len(transitions)), batch_size=case.batch)
    buffer.extend(transitions)

    def updates(count: int) -> None:
        for k in range(count):
            batch = buffer.sample()
            loss_critic, _ = loss.value_loss(batch)
            loss_critic.backward()
            critic_adam.step()
            critic_adam.zero_grad()
            if k % 2 == 0:
                loss_actor, _ = loss.actor_loss(batch)
                loss_actor.backward()
                actor_adam.step()
                actor_adam.zero_grad()
                targets.step()

    return updates


def collector(trainer: Trainer) -> SyncCollector:
    assert isinstance(trainer.collector, SyncCollector)
    return trainer.collector


def sb3(trainer: Trainer, case: Case, paths: int, frequency: int) -> TD3:
    """TD3 of Stable-Baselines3 on the same problem and simulator, which plays `frequency` steps at a time."""
    own = collector(trainer).env
    steps = {name: getattr(own.simulator, name) for name in ("dt", "substeps", "crossing")}
    env = ReachAvoidEnv(own.problem, **steps, num_envs=paths, initial_states=own.initial_states, seed=0)
    view = Paths(ReachAvoidVectorGym(env))
    m = own.problem.controls.dim
    return TD3(
        "MlpPolicy",
        view,
        batch_size=case.batch,
        policy_kwargs={"net_arch": {"pi": [*case.actor], "qf": [*case.critic]}, "activation_fn": nn.Tanh},
        action_noise=NormalActionNoise(torch.zeros(m).numpy(), 0.2 * torch.ones(m).numpy()),
        learning_starts=0,
        train_freq=frequency,
        seed=0,
        device="cpu",
    )


def update_sb3(trainer: Trainer, case: Case) -> Callable[[int], None]:
    model = sb3(trainer, case, 64, 5)
    model.gradient_steps = 0
    model.learn(6_400)
    return lambda count: model.train(count, case.batch)


def products(trainer: Trainer, case: Case) -> Callable[[int], None]:
    shape = Shape("TD3", trainer.learner.loss.problem, case.critic, case.batch, collocation=0, boundary=0)
    alone = MatrixProducts(shape)

    def updates(count: int) -> None:
        for _ in range(count):
            alone.update()

    return updates


def play_ours(trainer: Trainer) -> Callable[[], int]:
    own = collector(trainer)

    def play() -> int:
        before = own.buffer.write_count
        own._collect()
        return own.buffer.write_count - before

    return play


def step_ours(trainer: Trainer) -> Callable[[], int]:
    env = collector(trainer).env
    start = env.reset()
    start["action"] = torch.zeros(env.action_spec.shape)

    def play() -> int:
        for _ in range(10):
            env.step(start)
        return 10 * env.batch_size[0]

    return play


def play_sb3(trainer: Trainer, case: Case, paths: int) -> Callable[[], int]:
    model = sb3(trainer, case, paths, 100)
    model.gradient_steps = 0

    def play() -> int:
        before = model.num_timesteps
        model.learn(100 * paths, reset_num_timesteps=False)
        return model.num_timesteps - before

    return play


def turns(works: dict[str, Callable[[], float]], rounds: int) -> dict[str, float]:
    """The median rate of each work, where the works take turns and each returns what it did."""
    rates: dict[str, list[float]] = {name: [] for name in works}
    for work in works.values():
        work()
    for _ in range(rounds):
        for name, work in works.items():
            started = time.process_time()
            done = work()
            rates[name].append(done / (time.process_time() - started))
    return {name: statistics.median(entries) for name, entries in rates.items()}


def measure(case: Case, rounds: int, updates: int) -> dict[str, dict[str, float]]:
    trainer = ours(case)

    def counted(work: Callable[[int], None]) -> Callable[[], float]:
        return lambda: work(updates) or updates

    updating = {
        "pirl_rl": counted(update_ours(trainer)),
        "TorchRL, eager": counted(update_torchrl(trainer, case)),
        "Stable-Baselines3": counted(update_sb3(trainer, case)),
        "matrix products": counted(products(trainer, case)),
    }
    playing: dict[str, Callable[[], float]] = {
        "pirl_rl, environment": step_ours(trainer),
        "pirl_rl, collector": play_ours(trainer),
        "Stable-Baselines3, one environment": play_sb3(trainer, case, 1),
        "Stable-Baselines3, 64 paths": play_sb3(trainer, case, 64),
    }
    return {"updates a second": turns(updating, rounds), "played steps a second": turns(playing, max(3, rounds // 4))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--updates", type=int, default=50)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore", message="No target network updater")
    found: dict[str, Any] = {}
    ratios: dict[str, float] = {}
    for name, case in CASES.items():
        found[name] = measure(case, arguments.rounds, arguments.updates)
        for what, rates in found[name].items():
            ours = OURS[what]
            print(f"\n{name}, {what}, one thread\n\n| | rate | ours, times faster |\n|---|--:|--:|")
            for label, rate in rates.items():
                print(f"| {label} | {rate:,.0f} | {rates[ours] / rate:.1f} |")
                if not label.startswith("pirl_rl"):
                    ratios[f"{what}, {name}, {ours} / {label}"] = rates[ours] / rate
    save(arguments.json, ratios, found=found)


if __name__ == "__main__":
    main()
