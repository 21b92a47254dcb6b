"""What `pirl_rl.ReachAvoidFilter` saves of three bad nominal controllers, and how long a call takes.

For each run, nominal controller and mode it plays one episode from each start with V >= p + 0.05, and prints the
success without and with the filter, the exact lower bound (95 %) of the latter, the share of steps at which the filter
intervened, and the mean distance from the nominal control, in normalised controls, of the filtered control and of the
policy's at the same states.

python benchmarks/filter.py RUN_DIR ...             # success
python benchmarks/filter.py --time RUN_DIR ...      # the median CPU time of a call for one state
python benchmarks/filter.py --ahead RUN_DIR ...     # two ways to take the expectation of V one step ahead
"""

from __future__ import annotations

import argparse
import statistics
import time
import warnings
from collections.abc import Callable

import torch
from torch import Tensor

from pirl_rl import ReachAvoidFilter, Run, load_run
from pirl_rl.arguments import Policy
from pirl_rl.certificates import lower_bound
from pirl_rl.evaluation.monte_carlo import mean_payoff
from pirl_rl.filters import MODES, values_ahead

CALLS = 500
"""The number of calls that are timed."""

SAMPLE = 4_096
"""The number of quasi-random draws of the noise of one step."""


def starts(run: Run, count: int, least: float, most: float) -> tuple[Tensor, Tensor]:
    """Uniform times to go (N,) and states (N, n) with V between two bounds."""
    rng = torch.Generator().manual_seed(0)
    tau, x, problem = [], [], run.problem
    while sum(map(len, tau)) < count:
        state = problem.states.sample(100_000, rng)
        left = problem.horizon * torch.rand(len(state), generator=rng)
        value = run.solution.value(left, state)
        chosen = problem.interior(state) & (value >= least) & (value <= most)
        tau.append(left[chosen])
        x.append(state[chosen])
    return torch.cat(tau)[:count], torch.cat(x)[:count]


def nominal_controllers(run: Run) -> dict[str, Policy]:
    """The largest controls for ever, random controls, and the reversed policy."""
    controls, rng = run.problem.controls, torch.Generator().manual_seed(1)
    return {
        "constant": lambda tau, x: controls.denormalize(torch.ones(len(x), controls.dim)),
        "random": lambda tau, x: controls.sample(len(x), rng),
        "reversed": lambda tau, x: controls.denormalize(-controls.normalize(run.solution.policy(tau, x))),
    }


class Watched:
    """A filtered policy that counts what the filter does."""

    def __init__(self, run: Run, nominal: Policy, p: float, mode: str):
        self.run, self.nominal = run, nominal
        self.filter = ReachAvoidFilter(run, p=p, mode=mode)  # type: ignore[arg-type]
        self.steps, self.interventions, self.changed, self.replaced = 0, 0, 0.0, 0.0

    def __call__(self, tau: Tensor, x: Tensor) -> Tensor:
        normalize = self.run.problem.controls.normalize
        nominal, policy = self.nominal(tau, x), self.run.solution.policy(tau, x)
        control, intervened = self.filter.correct(tau, x, nominal)
        self.steps += len(x)
        self.interventions += int(intervened.sum())
        self.changed += (normalize(control) - normalize(nominal)).norm(dim=-1).sum().item()
        self.replaced += (normalize(policy) - normalize(nominal)).norm(dim=-1).sum().item()
        return control


def success(run: Run, policy: Policy, tau: Tensor, x: Tensor) -> int:
    """The number of successes, in one episode from each start."""
    return round(mean_payoff(run.simulator, policy, tau, x, 1, torch.Generator().manual_seed(2)).sum().item())


def play(run: Run, p: float, episodes: int, most: float) -> None:
    tau, x = starts(run, episodes, p + 0.05, most)
    name = type(run.problem).__name__
    print(f"| {name} | the policy | | {success(run, run.solution.policy, tau, x) / episodes:.3f} | | | | |", flush=True)
    for kind, nominal in nominal_controllers(run).items():
        without = success(run, nominal, tau, x) / episodes
        for mode in MODES:
            watched = Watched(run, nominal, p, mode)
            won = success(run, watched, tau, x)
            print(
                f"| {name} | {kind}, {without:.3f} | {mode} | {won / episodes:.3f} | "
                f"{float(lower_bound(won, episodes, 0.95)):.3f} | {watched.interventions / watched.steps:.2f} | "
                f"{watched.changed / watched.steps:.3f} | {watched.replaced / watched.steps:.3f} |",
                flush=True,
            )


def microseconds(call: Callable[[int], object]) -> float:
    """The median CPU time of calls with the numbers 0, 1, ..., after one that is not timed."""
    call(0)
    times = []
    for index in range(CALLS):
        started = time.process_time()
        call(index)
        times.append(time.process_time() - started)
    return 1e6 * statistics.median(times)


def clock(run: Run, p: float) -> None:
    x, nominal = starts(run, CALLS, 0.5, 1.0)[1].numpy(), nominal_controllers(run)["reversed"]
    cheap = nominal_controllers(run)["constant"]
    for mode in MODES:
        eager, fast = (ReachAvoidFilter(run, cheap, p, mode, compile=choice) for choice in (False, True))  # type: ignore[arg-type]
        each = [microseconds(lambda i, one=one: one(0.5, x[i : i + 1])) for one in (eager, fast)]
        print(f"| {type(run.problem).__name__} | {mode} | {each[0]:.0f} | {each[1]:.0f} |", flush=True)
    alone = microseconds(lambda i: nominal(torch.full((1,), 0.5), torch.as_tensor(x[i : i + 1])))
    print(f"| {type(run.problem).__name__} | policy alone | {alone:.0f} | |", flush=True)


def ahead(run: Run, p: float) -> None:
    """Mean and largest |error| of E[V] after a step at 100 states, against a quasi-random sample, and the times."""
    solution, simulator, problem = run.solution, run.simulator, run.problem
    tau, x = starts(run, 100, 0.5, 0.99)
    u = nominal_controllers(run)["reversed"](tau, x)

    def corrected(rows: slice) -> Tensor:
        h, sigma = tau[rows].clamp(max=simulator.dt), problem.diffusion(x[rows], u[rows])
        bend = (sigma * (solution.hessian(tau[rows], x[rows]) @ sigma)).sum((-2, -1)) / 2
        return solution.value(tau[rows] - h, simulator.flow(x[rows], u[rows], h)) + h * bend

    def cubature(rows: slice) -> Tensor:
        return values_ahead(solution, simulator, tau[rows], x[rows], u[rows]).mean(0)

    h, sigma = tau.clamp(max=simulator.dt), problem.diffusion(x, u)
    draws = torch.quasirandom.SobolEngine(sigma.shape[-1], scramble=True, seed=0).draw(SAMPLE).clamp(1e-6, 1 - 1e-6)
    kicks = torch.einsum("inw,sw->sin", sigma, torch.special.ndtri(draws)) * h.sqrt()[:, None]
    points = problem.states.wrap(simulator.flow(x, u, h) + kicks)
    values = solution.value((tau - h).expand(SAMPLE, -1).flatten(), points.flatten(0, 1)).reshape(SAMPLE, -1)
    for name, rule in (("flow and Itô correction", corrected), ("cubature", cubature)):
        error = (rule(slice(None)) - values.mean(0)).abs()
        spent = microseconds(lambda i, rule=rule: rule(slice(i % 100, i % 100 + 1)))
        print(
            f"| {type(problem).__name__} | {name} | {error.mean():.1e} | {error.max():.1e} | {spent:.0f} |", flush=True
        )


TABLES = {
    "success": "| Problem | Nominal, its success | Mode | Success | At least | Intervened | Distance | Of the policy |",
    "time": "| Problem | Mode | Eager (µs) | Compiled (µs) |",
    "ahead": "| Problem | Rule | Mean error | Largest | Time (µs) |",
}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="RUN_DIR")
    parser.add_argument("--p", type=float, default=0.9, help="the wanted probability of success")
    parser.add_argument("--episodes", type=int, default=2_000)
    parser.add_argument("--most", type=float, default=1.0, help="the largest V of a start")
    parser.add_argument("--time", action="store_true")
    parser.add_argument("--ahead", action="store_true")
    arguments = parser.parse_args()
    kind = "time" if arguments.time else "ahead" if arguments.ahead else "success"
    warnings.filterwarnings("ignore", message=".*far outside the box.*")
    print(f"{TABLES[kind]}\n{'| --- ' * (TABLES[kind].count('|') - 1)}|")
    for folder in arguments.runs:
        opened = load_run(folder)
        if kind == "success":
            play(opened, arguments.p, arguments.episodes, arguments.most)
        else:
            (clock if kind == "time" else ahead)(opened, arguments.p)
