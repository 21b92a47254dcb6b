"""Runs of the drifting problem, and the paper's networks for it, under the same evaluators.

    python benchmarks/drift_baselines.py RUN_DIR ... [--weights DIR] --out FOLDER

DIR holds the paper's networks as .npz files. All models are evaluated on the eight draws of states in
`benchmarks/draws`, see `drift_states.py`, on which nothing was chosen, and on 31 x 31 grids of the planes at tau = T,
under the same simulators and seeds. Each number over the states is a mean over the draws, plus or minus the standard
error of that mean. MSE and success are over all states, "band" over those with friction inside the band of the targets.
The paper's networks have two rows: unchanged, and masked with V = 0 where friction puts the target out of reach, as V
of our runs always is.

With --regression, the last row shows the accuracy that simulated outcomes alone allow. It is a network fitted to single
Monte Carlo outcomes of the first run's policy under the fine simulator, from states of the same protocol with friction
inside the band and from the planes, with other seeds. FOLDER gets `baselines.md`, `baselines.json` with all metrics,
and the figures of every model; accuracy is drawn for the first draw.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from pirl_rl import load_run
from pirl_rl.evaluation import Accuracy, Evidence, Rollouts, Slices, evaluate
from pirl_rl.evaluation.accuracy import SIMULATORS, AccuracyEvidence
from pirl_rl.evaluation.monte_carlo import Policy, mean_payoff
from pirl_rl.evaluation.reference_states import ReferenceStates, displaced, visited_by
from pirl_rl.figures import draw_all, save_figures
from pirl_rl.problems import VehicleDrift
from pirl_rl.problems.drift.reference_states import NETWORK_BOX
from pirl_rl.problems.drift.starts import EquilibriumStates
from pirl_rl.simulator import Simulator

DRAWS = sorted(Path(__file__).with_name("draws").glob("*.npz"))

COLUMNS = {
    "paper_mse": "paper: MSE",
    "paper_mse_band": "band",
    "paper_success": "success",
    "fine_mse": "fine: MSE",
    "fine_mse_band": "band",
    "fine_mse_far": "far",
    "fine_mse_farthest": "farthest",
    "fine_success": "success",
    "fine_success_band": "band",
    "fine_precision_p50": "precision V > 0.5",
    "fine_recall_p50": "recall",
    "slice_beta_r_mae": "beta-r: MAE",
    "slice_beta_r_success": "success",
    "slice_e_y_e_psi_mae": "e_y-e_psi: MAE",
    "slice_e_y_e_psi_success": "success",
}
SEED = 7


class DriftSolution:
    """Has the interface of a `Solution` of the drifting problem; V is masked where the problem knows it."""

    dtype, device = torch.float32, torch.device("cpu")

    def __init__(self):
        self.problem = VehicleDrift()

    def policy(self, tau: Tensor, x: Tensor) -> Tensor:
        raise NotImplementedError

    def raw_value(self, tau: Tensor, x: Tensor) -> Tensor:
        raise NotImplementedError

    def value(self, tau: Tensor, x: Tensor) -> Tensor:
        lost = self.problem.failed(x) | self.problem.unreachable(x)
        return self.raw_value(tau, x).masked_fill(self.problem.reached(x), 1.0).masked_fill(lost, 0.0)


class Baseline(DriftSolution):
    """Networks of the paper: an actor 8-32-32-2 with ReLU and tanh, and two critics 10-64-64-64-1 with tanh and
    sigmoid, whose mean is V."""

    def __init__(self, path: Path):
        super().__init__()
        with np.load(path, allow_pickle=False) as file:
            weights = {name: torch.from_numpy(file[name]) for name in file.files if name.endswith(("weight", "bias"))}
        self.actor = _stack(weights, "actor.net.", nn.ReLU(), nn.Tanh())
        self.critics = [_stack(weights, f"critic.{twin}_net.net.", nn.Tanh(), nn.Sigmoid()) for twin in ("q1", "q2")]

    def policy(self, tau: Tensor, x: Tensor) -> Tensor:
        return self.problem.controls.denormalize(self.actor(network_inputs(tau, x)))

    def raw_value(self, tau: Tensor, x: Tensor) -> Tensor:
        inputs = network_inputs(tau, x)
        inputs = torch.cat([inputs, self.actor(inputs)], -1)
        return torch.stack([critic(inputs).squeeze(-1) for critic in self.critics]).mean(0)


class Regression(DriftSolution):
    """V of a given policy by regression of simulated outcomes: three layers of 128 tanh units, binary cross-entropy,
    Adam with cosine decay.

    Args:
        policy: the policy.
        updates: number of updates.
        rollouts: number of simulated outcomes.
    """

    def __init__(self, policy: Policy, updates: int, rollouts: int):
        super().__init__()
        self._policy = policy
        torch.manual_seed(SEED)
        widths = (8, 128, 128, 128)
        layers = [layer for a, b in pairwise(widths) for layer in (nn.Linear(a, b), nn.Tanh())]
        self.network = nn.Sequential(*layers, nn.Linear(128, 1))
        self._fit(*outcomes(self.problem, policy, rollouts), updates)

    def policy(self, tau: Tensor, x: Tensor) -> Tensor:
        return self._policy(tau, x)

    @torch.no_grad()
    def raw_value(self, tau: Tensor, x: Tensor) -> Tensor:
        return self.network(network_inputs(tau, x)).squeeze(-1).sigmoid()

    def _fit(self, inputs: Tensor, payoff: Tensor, updates: int) -> None:
        optimizer = torch.optim.Adam(self.network.parameters(), lr=2e-3)
        decay = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, updates)
        for _ in range(updates):
            batch = torch.randint(len(inputs), (2_048,))
            logit = self.network(inputs[batch]).squeeze(-1)
            optimizer.zero_grad()
            nn.functional.binary_cross_entropy_with_logits(logit, payoff[batch]).backward()
            optimizer.step()
            decay.step()


def outcomes(problem: VehicleDrift, policy: Policy, count: int) -> tuple[Tensor, Tensor]:
    """Network inputs (N, 8) and payoffs (N,) of single paths from about `count` states of the reference protocol, and
    from a tenth of this number on each plane at tau = T."""
    rng = torch.Generator().manual_seed(SEED)
    visited = visited_by(Simulator(problem, **SIMULATORS["paper"]), policy, EquilibriumStates(), 8_192, rng)
    states = [displaced(problem, *visited, NETWORK_BOX, rng, count, 0.40)]
    for plane in problem.planes.values():
        x = plane.embed(plane.box.sample(count // 10, rng))
        states.append((torch.full((len(x),), problem.horizon), x))
    tau, x = (torch.cat(parts) for parts in zip(*states, strict=True))
    kept = problem.interior(x) & ~problem.unreachable(x)
    tau, x = tau[kept], x[kept]
    payoff = mean_payoff(Simulator(problem, **SIMULATORS["fine"]), policy, tau, x, 1, rng)
    return network_inputs(tau, x), payoff.float()


def network_inputs(tau: Tensor, x: Tensor) -> Tensor:
    """tau and x scaled to [-1, 1], (N, 8)."""
    return NETWORK_BOX.normalize(torch.cat([tau.unsqueeze(-1), x], -1))


def _stack(weights: Mapping[str, Tensor], prefix: str, activation: nn.Module, output: nn.Module) -> nn.Sequential:
    layers: list[nn.Module] = []
    for name in sorted(name for name in weights if name.startswith(prefix) and name.endswith("weight")):
        inputs, outputs = weights[name].T.shape
        linear = nn.Linear(inputs, outputs)
        linear.load_state_dict({"weight": weights[name], "bias": weights[name.replace("weight", "bias")]})
        layers += [linear, activation]
    return nn.Sequential(*layers[:-1], output).requires_grad_(False)


def unmasked(accuracy: Evidence) -> AccuracyEvidence:
    """The same evidence with V of the networks alone, without the masks."""
    assert isinstance(accuracy, AccuracyEvidence)
    raw = {name: dataclasses.replace(one, value=one.raw_value) for name, one in accuracy.comparisons.items()}
    return dataclasses.replace(accuracy, comparisons=raw)


def averaged(draws: Sequence[Evidence]) -> dict[str, float]:
    """The mean of each metric over the draws, and its standard error under the same name with `_error`."""
    found = [draw.metrics() for draw in draws]
    numbers = {}
    for key in found[0]:
        values = np.array([metrics[key] for metrics in found])
        numbers |= {key: values.mean().item(), f"{key}_error": (values.std(ddof=1) / len(values) ** 0.5).item()}
    return numbers


def markdown(results: Mapping[str, Mapping[str, float]]) -> str:
    columns = [key for key in COLUMNS if all(key in numbers for numbers in results.values())]
    lines = [f"| model | {' | '.join(COLUMNS[key] for key in columns)} |", "|---" + "|--:" * len(columns) + "|"]
    for model, numbers in results.items():
        cells = [model]
        for key in columns:
            digits = ".4f" if "mse" in key else ".3f"
            error = f" ± {numbers[f'{key}_error']:{digits}}" if f"{key}_error" in numbers else ""
            cells.append(f"{numbers[key]:{digits}}{error}")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="*", metavar="RUN_DIR")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--rollouts", type=int, default=128, help="paths from each state of the draws")
    parser.add_argument("--slice-rollouts", type=int, default=64, help="paths from each point of the planes, or 0")
    parser.add_argument("--regression", action="store_true", help="add the regression of the first run's outcomes")
    parser.add_argument("--fit-updates", type=int, default=10_000, help="updates of the regression")
    parser.add_argument("--fit-rollouts", type=int, default=1_000_000, help="simulated outcomes for the regression")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    results: dict[str, dict[str, float]] = {}
    evaluators = {str(path): Accuracy(partial(ReferenceStates.load, path), arguments.rollouts) for path in DRAWS}
    planes = {}
    if arguments.slice_rollouts:
        planes = {"slices": Slices(rollouts=arguments.slice_rollouts), "rollouts": Rollouts()}

    def measure(name: str, solution) -> None:
        simulator = Simulator(solution.problem, **SIMULATORS["fine"])
        draws = [*evaluate(solution, simulator, evaluators).values()]
        shown = evaluate(solution, simulator, planes)
        slices = shown["slices"].metrics() if shown else {}
        if isinstance(solution, Baseline):
            results[name] = averaged([unmasked(draw) for draw in draws]) | slices
            name = f"{name}, masked"
        results[name] = averaged(draws) | slices
        folder = arguments.out / name.replace(", ", "-").replace("/", "-")
        save_figures(draw_all({"accuracy": draws[0], **shown}), folder)
        print(markdown({name: results[name]}).splitlines()[-1], flush=True)

    for path in sorted(arguments.weights.glob("*.npz")) if arguments.weights else ():
        measure(path.stem, Baseline(path))
    solutions = {"/".join(run.parts[-2:]): load_run(run).solution for run in arguments.runs}
    for name, solution in solutions.items():
        measure(name, solution)
    if solutions and arguments.regression:
        name, solution = next(iter(solutions.items()))
        fitted = Regression(solution.policy, arguments.fit_updates, arguments.fit_rollouts)
        measure(f"{name}, regression of its outcomes", fitted)
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "baselines.md").write_text(markdown(results))
    (arguments.out / "baselines.json").write_text(json.dumps(results, indent=2) + "\n")
    print("\n" + markdown(results))


if __name__ == "__main__":
    main()
