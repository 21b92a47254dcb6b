"""The cost of the HJB term in the number N of points, w of noise channels and n of states, exact and randomised.

    python benchmarks/dimension.py [--rounds 15] [--eager] [--short] [--json FILE] [--figure FILE]

The problem is the half-space of the suite with its noise spread over w channels. The critic has three layers of 64 and
the actor two, half the width of those of the default recipe, and the critic has no logarithms of the levels. A term is
this loss alone, forward and backward, on one thread: the exact trace has a column for each channel, the randomised one
the number of random vectors that trainings take. Beside each stand the products of matrices that it needs, in
`torch.matmul` of equal shapes with nothing between them. The exponents are those of power laws, fitted to the three
largest values of N, w or n; all other sizes stay at their largest.

Times are those of the processor, which leave out the waits for other processes, and the smallest of rounds in which all
cases take turns. `--eager` leaves the terms of the sweeps uncompiled. `--short` measures one case alone, uncompiled and
with so few points that its arrays stay in the cache.

Three more measurements compare both traces: the bias of the randomised loss and of its gradient, in standard errors of
the mean over many draws; the variance of the gradient over batches, for a critic that was fitted to the exact value;
and the memory that is held for the backward pass, beside the bound that the documentation states.
"""

from __future__ import annotations

import argparse
import json
import operator
import statistics
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from benchmarks.record import save
from pirl_rl.actor_rules import Hamiltonian
from pirl_rl.automatic import PROBES
from pirl_rl.compilation import compiled
from pirl_rl.figures import save_figures
from pirl_rl.layers import Dense
from pirl_rl.losses import PIRLLoss
from pirl_rl.machine import keep_freed_memory
from pirl_rl.networks import Actor, Critic
from pirl_rl.problems import HalfSpace
from pirl_rl.sampling.collocation import Collocation

FITTED = 3
"""The number of the largest values of a sweep to which a power law is fitted."""

RECIPE = {"activation": "SiLU", "spread": 3.0, "levels": True, "root_time": True}
TRACES = {"exact": 0, "randomised": PROBES}


class Channels(HalfSpace):
    """`HalfSpace` in n dimensions; the channel i mod w moves x_i, if `varying` with the strength 1 + x_i^2/9."""

    def __init__(self, dim: int, channels: int, varying: bool = False):
        super().__init__(dim=dim)
        self.matrix = torch.eye(channels).repeat(-(-dim // channels), 1)[:dim]
        self.varying = varying

    def diffusion(self, x: Tensor, u: Tensor) -> Tensor:
        if self.varying:
            return self.matrix.to(x) * (1 + x.square() / 9).unsqueeze(-1)
        return self.matrix.to(x).expand(*x.shape[:-1], *self.matrix.shape)


@dataclass(frozen=True)
class Case:
    """N points of a problem with n states and w channels, and whether sigma depends on the state."""

    points: int = 1_000
    channels: int = 100
    states: int = 100
    varying: bool = False


LARGEST = Case()
CACHED = replace(LARGEST, points=125)
"""The case of the short version."""

SWEEPS = {
    "points N": [replace(LARGEST, points=points) for points in (125, 250, 500, 1_000, 2_000)],
    "channels w": [replace(LARGEST, channels=channels) for channels in (1, 4, 10, 20, 50, 100)],
    "states n, w = n": [replace(LARGEST, channels=states, states=states) for states in (4, 10, 25, 50, 100)],
    "states n, w = 4": [replace(LARGEST, channels=4, states=states) for states in (4, 10, 25, 50, 100)],
}


class Term:
    """The HJB term of one case: `both()` computes the loss and its gradient."""

    def __init__(self, case: Case, probes: int, delta: float | None = 1.0, compile: bool = False):
        torch.manual_seed(0)
        self.problem = Channels(case.states, case.channels, case.varying)
        self.actor = Actor(self.problem, (64, 64), **RECIPE)
        self.critic = Critic(self.problem, (64, 64, 64), output="Sigmoid", **RECIPE)
        self.build(probes, delta)
        self.collocation, self.rng = Collocation(self.problem, case.points), torch.Generator().manual_seed(0)
        self.draw()
        if compile:
            self.hjb_loss = compiled(self.loss.critic_loss)

    def draw(self) -> TensorDict:
        """Draw other points; returns the batch with them."""
        action = torch.zeros(1, self.problem.controls.dim)
        points = self.collocation.sample(self.rng)
        self.batch = TensorDict({"replay": TensorDict({"action": action}), "collocation": points})
        return self.batch

    def build(self, probes: int, delta: float | None) -> None:
        """The loss of the networks as they are."""
        options: dict[str, Any] = {"hjb_probes": probes, "hjb_delta": delta, "hjb_weight": 1.0}
        self.loss = PIRLLoss(self.problem, self.actor, [self.critic], Hamiltonian(self.problem), **options)
        self.hjb_loss: Callable[..., tuple[Tensor, Any]] = self.loss.critic_loss

    def both(self) -> Tensor:
        """The loss, followed by all entries of its gradient."""
        loss, _ = self.hjb_loss(self.batch)
        slopes = torch.autograd.grad(loss, list(self.loss.qvalue_network_params.parameters()), materialize_grads=True)
        return torch.cat([loss.detach().view(1), *(slope.flatten() for slope in slopes)])

    def fit(self, updates: int) -> None:
        """Fit the critic to the exact value, and the actor to the optimal control, on random points."""
        adam = torch.optim.Adam([*self.critic.parameters(), *self.actor.parameters()], 3e-3)
        for update in range(updates):
            adam.param_groups[0]["lr"] = 3e-3 * (1 - update / updates)
            batch = Collocation(self.problem, 1_024).sample(self.rng)
            tau, x = batch["tau"], batch["state"]
            action = self.problem.controls.normalize(self.problem.optimal_control(tau.squeeze(-1), x))
            value = self.problem.exact_value(tau.squeeze(-1), x)
            logits = self.critic.logits(tau, x, action).squeeze(-1)
            entropy = binary_cross_entropy_with_logits(logits, value, weight=batch["mask"].float())
            adam.zero_grad()
            (entropy + (self.actor(tau, x) - action).square().mean()).backward()
            adam.step()


def products(case: Case, probes: int) -> Callable[[], None]:
    """The products of matrices of a term: forward, and backward in the weights and in the inputs of a layer.

    The rows are values, drifts and columns of N points each. The first layer needs no gradient in its inputs, and the
    random vectors that give the weight of Huber's loss need none at all. Both kinds are multiplied by sigma.
    """
    streams = (1, probes, probes) if probes else (1, 1, case.channels)
    term = Term(replace(case, points=1), probes)
    critic, draws = term.critic, torch.randn(probes * case.points, case.channels)
    steps: list[tuple[Tensor, Tensor]] = [(draws, term.problem.matrix.mT)] * (2 if probes else 0)
    for index, layer in enumerate(layer for layer in critic.layers if isinstance(layer, Dense)):
        weight = layer.weight.detach()
        for count in streams:
            rows, slopes = (torch.randn(count * case.points, width) for width in (weight.shape[1], weight.shape[0]))
            steps += [(rows, weight.mT), (slopes.mT, rows)]
            steps += [(slopes, weight)] if index else []
            steps += [(rows, weight.mT)] if probes else []

    def multiply() -> None:
        for left, right in steps:
            torch.matmul(left, right)

    return multiply


def measure(cases: Sequence[tuple[Case, bool]], rounds: int) -> list[dict[str, Any]]:
    """The times of both traces and of their products, in ms: the smallest of rounds in which all of them take turns.

    Beside them stands "quotient", the median over the rounds of the time of the exact trace by that of the randomised
    one. It varies less than the smallest times where other processes share the caches.

    Args:
        cases: cases, and whether their terms are compiled.
        rounds: the number of rounds.
    """
    works: list[dict[str, Callable[[], Any]]] = []
    for case, compile in cases:
        works.append({})
        for trace, probes in TRACES.items():
            works[-1][trace] = Term(case, probes, compile=compile).both
            works[-1][f"{trace}, products"] = products(case, probes)
        for work in works[-1].values():
            work()
    times: list[dict[str, list[float]]] = [{name: [] for name in variants} for variants in works]
    for _ in range(rounds):
        for variants, entries in zip(works, times, strict=True):
            for name, work in variants.items():
                start = time.process_time()
                work()
                entries[name].append(1e3 * (time.process_time() - start))
    return [
        {
            **asdict(case),
            "compiled": compile,
            "ms": {name: min(values) for name, values in entries.items()},
            "quotient": statistics.median(map(operator.truediv, *(entries[trace] for trace in TRACES))),
        }
        for (case, compile), entries in zip(cases, times, strict=True)
    ]


def exponents(values: Sequence[float], rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """The exponents of power laws of the times in the largest values."""
    logs = np.log(values[-FITTED:])
    return {
        name: float(np.polyfit(logs, np.log([row["ms"][name] for row in rows[-FITTED:]]), 1)[0])
        for name in rows[0]["ms"]
    }


def varied(name: str, case: Case) -> int:
    """The size of a case that a sweep varies."""
    return {"p": case.points, "c": case.channels, "s": case.states}[name[0]]


def ratios(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """The quotients of the times of both traces, by the case of each row."""
    result = {}
    for row in rows:
        sigma, how = "varying" if row["varying"] else "constant", "compiled" if row["compiled"] else "eager"
        case = f"{row['points']} points, {row['states']} states, {row['channels']} channels, {sigma} sigma, {how}"
        result[f"HJB term, {case}, exact / randomised"] = row["quotient"]
    return result


def sweep(name: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The rows of a sweep, out of those of all compiled cases, and what is fitted to them."""
    cases = [asdict(case) for case in SWEEPS[name]]
    own = [row for case in cases for row in rows if case.items() <= row.items()]
    values = [varied(name, case) for case in SWEEPS[name]]
    return {"values": values, "rows": own, "exponents": exponents(values, own)}


def show(report: Mapping[str, Any]) -> None:
    """Print the report of all measurements."""
    for row in report["largest"]:
        print(row)
    for name, result in report["sweeps"].items():
        print(f"\n{name}")
        for value, row in zip(result["values"], result["rows"], strict=True):
            print(f"{value:6d}", ", ".join(f"{variant} {time:.1f} ms" for variant, time in row["ms"].items()))
        print("exponents:", ", ".join(f"{variant} {value:.2f}" for variant, value in result["exponents"].items()))
    for name in ("memory", "bias", "noise"):
        print(f"\n{name}: {json.dumps(report[name], indent=2)}")


def bias(case: Case, draws: int) -> dict[str, float]:
    """Deviations of the mean over draws from the exact loss and gradient, in standard errors; see the test."""
    exact, ours = Term(case, 0, None).both(), Term(case, PROBES, None)
    slope = exact[1:] / exact[1:].norm()
    directions = torch.nn.functional.normalize(torch.randn(4, len(slope)), dim=-1)
    seen = torch.block_diag(torch.ones(1, 1), torch.cat([slope[None], directions]))
    drawn = torch.stack([seen @ ours.both() for _ in range(draws)]).double()
    error = drawn.std(0) / draws**0.5
    deviations = ((drawn.mean(0) - (seen @ exact).double()) / error).tolist()
    names = ["loss", "gradient along the exact one", *(f"gradient along direction {i}" for i in range(1, 5))]
    return {**dict(zip(names, deviations, strict=True)), "error of the loss": (error[0] / exact[0]).item()}


def noise(states: int, batches: int, updates: int = 400) -> dict[str, Any]:
    """The variance of the gradient over batches of 300 points, by the number of probes, over that of the exact one."""
    term = Term(Case(300, states, states), 0)
    term.fit(updates)
    samples = [term.draw() for _ in range(batches)]
    total = {}
    for count in (0, 2, 4, 8):
        term.build(count, 1.0)
        gradients = []
        for term.batch in samples:
            gradients.append(term.both()[1:])
        total[count] = torch.stack(gradients).var(0).sum().item()
    return {"states": states, "variance": {str(count): total[count] / total[0] for count in total}}


def memory(case: Case, probes: int) -> dict[str, float]:
    """MB that autograd holds between the passes, and the bound of the documentation."""
    term, held = Term(case, probes), {}

    def pack(entry: Tensor) -> Tensor:
        held[entry.untyped_storage().data_ptr()] = entry.untyped_storage().nbytes()
        return entry

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda entry: entry):
        loss, _ = term.hjb_loss(term.batch)
        kept = sum(held.values())
        loss.backward()
    dense = [layer for layer in term.critic.layers if isinstance(layer, Dense)]
    inputs, widths = dense[0].in_features, sum(layer.out_features for layer in dense[:-1])
    streams = 2 * probes if probes else 1 + case.channels
    return {"held": kept / 1e6, "bound": 4 * case.points * (streams + 8) * (inputs + 2 * widths) / 1e6}


def draw(sweeps: Mapping[str, Any]) -> Figure:
    figure = Figure(figsize=(11, 7.2), layout="constrained")
    for panel, (name, result) in zip(figure.subplots(2, 2).flat, sweeps.items(), strict=True):
        for color, trace in zip(("C0", "C1"), TRACES, strict=True):
            for variant, style in ((trace, "o-"), (f"{trace}, products", "x--")):
                label = f"{variant}: exponent {result['exponents'][variant]:.2f}"
                times = [row["ms"][variant] for row in result["rows"]]
                panel.loglog(result["values"], times, style, color=color, label=label)
        panel.set(xlabel=name, ylabel="ms, forward and backward")
        panel.set_xticks(result["values"], [str(value) for value in result["values"]], minor=False)
        panel.set_xticks([], minor=True)
        panel.grid(alpha=0.3)
        # Room for the legend above the curves.
        panel.set_ylim(top=panel.get_ylim()[1] ** 1.5 / panel.get_ylim()[0] ** 0.5)
        panel.legend(fontsize="small", loc="upper left")
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--eager", action="store_true")
    parser.add_argument("--short", action="store_true")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--figure", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    keep_freed_memory()
    warnings.filterwarnings("ignore", message="No target network updater")
    if arguments.short:
        rows = measure([(CACHED, False)], 2 * arguments.rounds)
        print("| HJB term, eager | ms |\n|---|--:|")
        print("\n".join(f"| {variant} | {time:.1f} |" for variant, time in rows[0]["ms"].items()))
        save(arguments.json, ratios(rows), rows=rows)
        return
    report: dict[str, Any] = {"probes": PROBES, "compiled": not arguments.eager}
    report["memory"] = {trace: memory(LARGEST, probes) for trace, probes in TRACES.items()}
    report["bias"] = bias(replace(LARGEST, points=200), 400)
    report["noise"] = [noise(states, 40) for states in (8, 16, 32, 100)]
    changing = replace(LARGEST, varying=True)
    distinct = dict.fromkeys(case for cases in SWEEPS.values() for case in cases)
    swept = [(case, not arguments.eager) for case in distinct]
    others = [(LARGEST, False), (changing, False), (changing, True)]
    rows = measure([*swept, *others], arguments.rounds)
    report["largest"] = rows[len(swept) :]
    report["sweeps"] = {name: sweep(name, rows[: len(swept)]) for name in SWEEPS}
    show(report)
    sizes = ("points", "channels", "states")
    largest = [row for row in rows if all(row[size] == getattr(LARGEST, size) for size in sizes)]
    save(arguments.json, ratios(largest), **report)
    if arguments.figure:
        save_figures({arguments.figure.stem: draw(report["sweeps"])}, arguments.figure.parent)


if __name__ == "__main__":
    main()
