"""The command that runs all benchmarks: comparison of ratios, benchmarks that cannot run, and what it prints."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import torch
from small import small_trainer
from torch import Tensor

from benchmarks import __main__ as command
from benchmarks import dimension, ratios, time_to_accuracy
from benchmarks.kinds import PROBLEMS
from benchmarks.kinds.other_constants import CONSTANTS, OTHERS, drawn
from benchmarks.ratios import WORSE, compare, table
from pirl_rl import Box
from pirl_rl.evaluation.monte_carlo import monte_carlo
from pirl_rl.gradients import Gradient
from pirl_rl.grid import GridSolver
from pirl_rl.layers import Dense
from pirl_rl.problems import DubinsCar
from pirl_rl.sampling.initial_states import sample_interior

FAKE = """
import json, sys
ratio, _, path = sys.argv[1:]
print("| a table |", flush=True)
with open(path, "w") as file:
    json.dump({"machine": {}, "ratios": {"theirs / ours": float(ratio)}, "rows": [1]}, file)
"""
"""A benchmark that measures nothing."""


def test_a_ratio_that_has_become_worse_gets_a_warning():
    (warning,) = compare({"a": 1.0, "b": 2.0}, {"a": 1.1 * WORSE, "b": 2.0})
    assert warning.startswith(f"warning: 'a' is 1.00, and {1.1 * WORSE:.2f} is stored.")


def test_ratios_that_are_near_the_stored_ones_or_better_get_none():
    stored = {"a": 0.99 * WORSE, "b": 2.0, "c": 2.0}
    assert compare({"a": 1.0, "b": 9.0, "c": 2.0}, stored) == ["No ratio has become worse."]


def test_a_ratio_that_is_no_number_gets_a_warning():
    (warning,) = compare({"a": float("nan")}, {"a": 1.0})
    assert warning.startswith("warning: 'a' is nan")


def test_ratios_that_are_not_stored_are_counted():
    lines = compare({"a": 1.0, "b": 2.0, "c": 3.0}, {"a": 1.0})
    assert lines == ["No ratio has become worse.", "Ratios that are not stored: 2 of 3."]


def test_nothing_is_said_about_a_stored_ratio_that_was_not_measured():
    assert compare({}, {"a": 1.0}) == ["No ratio has become worse."]


def test_the_table_has_both():
    assert table({"a": 1.0, "b": 2.0}, {"a": 3.0}).splitlines()[2:] == ["| a | 1.00 | 3.00 |", "| b | 2.00 |  |"]


def test_what_is_stored_belongs_to_the_short_version():
    """Each of its benchmarks has a stored ratio, so that none of them is left without a comparison."""
    names = {name.partition(":")[0] for name in ratios.read(ratios.STORED)["ratios"]}
    assert names >= set(command.SHORT)


def test_every_benchmark_is_a_file():
    files = [line.split()[0] for line in (*command.ALL.values(), *command.SHORT.values())]
    assert all((command.FOLDER / file).is_file() for file in files)


@pytest.mark.parametrize("name", ["the 1-D problem", pytest.param("the drifting vehicle", marks=pytest.mark.slow)])
def test_peers_compares_networks_of_the_widths_that_it_names(name):
    pytest.importorskip("stable_baselines3", reason="needs the extra baselines")
    from benchmarks import peers

    case = peers.CASES[name]
    loss = peers.ours(case).learner.loss
    for network, widths in ((loss.solution().actor, case.actor), (loss.solution().critic, case.critic)):
        dense = [layer for layer in network.layers if isinstance(layer, Dense)]
        assert [layer.out_features for layer in dense[:-1]] == [*widths]


def test_nested_autograd_computes_the_same_residual():
    """Both variants of the benchmark have equal networks and points, so that their HJB losses and gradients agree."""
    from benchmarks import learner

    variants = [learner.Variant(learner.SHAPES[1], nested=nested, compiled=False) for nested in (True, False)]
    losses, _, gradients = zip(*(each.hjb_loss(each.batch["collocation"]) for each in variants), strict=True)
    assert isinstance(variants[0].loss.hjb, learner.NestedResidual)
    assert losses[0].item() == pytest.approx(losses[1].item(), rel=1e-4)
    for nested, own in zip(*gradients, strict=True):
        if own is None:  # the last bias, which no derivative of V depends on
            assert nested is None
            continue
        torch.testing.assert_close(nested, own, rtol=1e-3, atol=1e-4 * own.abs().max().item())


def test_processes_that_share_a_batch_step_along_the_mean_gradient(tmp_path, monkeypatch):
    """With gradients that are averaged to 0, the networks stay as they are."""
    from benchmarks import data_parallel

    def vanishing(gradient: Gradient) -> Gradient:
        return gradient[0], gradient[1], tuple(None if entry is None else 0 * entry for entry in gradient[2])

    monkeypatch.setattr(data_parallel, "average", vanishing)
    trainer = small_trainer(tmp_path)
    before = trainer.learner.loss.state_dict()
    before = {name: entry.clone() for name, entry in before.items() if "_params." in name and "target" not in name}
    data_parallel.share_gradients(trainer)
    trainer.train()
    after = trainer.learner.loss.state_dict()
    assert before
    assert all(torch.equal(entry, after[name]) for name, entry in before.items())


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A folder with one benchmark, from which the command takes its files."""
    (tmp_path / "fake.py").write_text(FAKE)
    monkeypatch.setattr(command, "FOLDER", tmp_path)
    return tmp_path


def run(folder: Path, monkeypatch, *arguments: str, **commands: str) -> None:
    """Run the command with other benchmarks, with results in results.json and stored ratios in stored.json."""
    monkeypatch.setattr(sys, "argv", ["benchmarks", "--short", "--json", str(folder / "results.json"), *arguments])
    monkeypatch.setattr(command, "SHORT", commands)
    command.main(folder / "stored.json")


def test_it_prints_tables_stores_ratios_and_warns_of_worse_ones(folder, monkeypatch, capfd):
    run(folder, monkeypatch, "--store", fake="fake.py 3.0")
    printed = capfd.readouterr().out
    assert "## fake: fake.py 3.0" in printed
    assert "| a table |" in printed
    assert "| fake: theirs / ours | 3.00 |  |" in printed
    assert "warning" not in printed

    run(folder, monkeypatch, fake="fake.py 2.9")
    printed = capfd.readouterr().out
    assert "| fake: theirs / ours | 2.90 | 3.00 |" in printed
    assert "No ratio has become worse." in printed

    run(folder, monkeypatch, fake="fake.py 1.0")
    assert "warning: 'fake: theirs / ours' is 1.00, and 3.00 is stored." in capfd.readouterr().out
    results = json.loads((folder / "results.json").read_text())
    assert results["ratios"] == {"fake: theirs / ours": 1.0}
    assert results["benchmarks"] == {"fake": {"rows": [1]}}
    assert results["machine"]["python"]


def test_benchmarks_that_cannot_run_are_left_out_with_a_sentence(folder, monkeypatch, capfd):
    monkeypatch.setitem(command.NEEDS, "extra", ("json", "no_such_module"))
    with pytest.raises(SystemExit, match="error: benchmarks that failed: broken"):
        run(folder, monkeypatch, "--store", extra="fake.py 1.0", broken="fake.py nonsense", fake="fake.py 2.0")
    printed = capfd.readouterr().out
    assert "skipped: The benchmark needs no_such_module, which this Python does not have." in printed
    assert "skipped: The benchmark failed with exit status 1." in printed
    assert "| fake: theirs / ours | 2.00 |" in printed
    assert json.loads((folder / "results.json").read_text())["skipped"].keys() == {"extra", "broken"}
    assert not (folder / "stored.json").exists(), "what failed would have no ratio there"


# Time to accuracy


def row(update: int, mse: float, seconds: float) -> dict[str, float]:
    return {"update": update, "mse": mse, "seconds": seconds, "processor": seconds / 2}


@pytest.mark.parametrize("probes", [0, 4])
def test_the_memory_of_a_term_is_below_the_bound_that_the_documentation_states(probes):
    """And above half of it: the bound should say how much is needed."""
    found = dimension.memory(dimension.Case(points=64, channels=6, states=6), probes)
    assert 0.5 * found["bound"] < found["held"] <= found["bound"]


def test_random_vectors_add_no_variance_where_the_trace_has_one_channel():
    """With one channel a Rademacher vector is its sign, so that its estimate is exact; with Huber's weight 1 too."""
    found = dimension.noise(states=1, batches=6, updates=5)
    assert found["states"] == 1
    assert found["variance"] == pytest.approx(dict.fromkeys("0248", 1.0), rel=0.02)


def test_a_bound_is_reached_at_the_first_update_below_it():
    curve = [row(50, 1e-2, 20.0), row(100, 9e-4, 21.0), row(150, 2e-3, 22.0), row(200, 5e-4, 23.0)]
    run = {"first update": {"seconds": 15.0, "processor": 8.0}, "curve": curve}
    found = time_to_accuracy.reached(run, 1e-3)
    expected = {"update": 100, "seconds": 21.0, "processor": 10.5}
    assert found == {**expected, "training seconds": 6.0, "training processor": 2.5}
    assert time_to_accuracy.reached(run, 1e-4) is None


def test_clocks_stand_still_in_pauses(monkeypatch):
    now = iter([10.0, 12.0, 15.0, 15.5])
    monkeypatch.setattr(
        time_to_accuracy.Clocks, "_now", staticmethod(lambda: dict.fromkeys(time_to_accuracy.CLOCKS, next(now)))
    )
    clocks = time_to_accuracy.Clocks(started=9.0)
    assert clocks.read() == {"seconds": 1.0, "processor": 10.0}
    assert clocks.pause(lambda: "result") == "result"
    assert clocks.read() == {"seconds": 3.5, "processor": 12.5}


def test_the_table_has_both_clocks_and_leaves_out_what_is_not_reached():
    medians = {"update": 100, "seconds": 21.0, "processor": 10.5, "training seconds": 6.0, "training processor": 2.5}
    found = {"problem": "reach1d", "bound": 1e-3, "reached": 1, "runs": 2}
    grid = {"seconds": 0.2, "processor": 0.1, "mse": 1e-4}
    line = time_to_accuracy.show({**found, "medians": medians, "grid": grid})
    assert line == "| reach1d | 1.0e-03 | 1 of 2 | 100 | 21.0 (10.5) | 6.0 (2.5) | 0.20 (0.10) |"
    line = time_to_accuracy.show({**found, "medians": None, "grid": None})
    assert line == "| reach1d | 1.0e-03 | 1 of 2 |  |  |  |  |"


def test_a_mixture_succeeds_with_the_product_of_the_probabilities_of_its_parts():
    problem, rollouts = PROBLEMS["Bearing"](), 150
    x = sample_interior(problem, problem.states, 25, torch.Generator().manual_seed(0), torch.float64)
    tau = torch.full((25,), problem.horizon / 3, dtype=torch.float64)
    clock = {"rollouts": rollouts, "dt": problem.horizon / 200}
    parts = [(part, GridSolver(part, 31, margin=[0.0, 0.0], estimate=False).solve(), z) for part, z in problem.split(x)]

    def policy(tau: Tensor, x: Tensor) -> Tensor:
        pairs = zip(parts, problem.split(x), strict=True)
        return torch.cat([grid.policy(tau, z) for (_, grid, _), (_, z) in pairs], -1)

    together = monte_carlo(problem, policy, tau, x, **clock).probability
    apart = [monte_carlo(part, grid.policy, tau, z, **clock).probability for part, grid, z in parts]
    assert 0.3 < together.mean() < 0.9
    error = torch.stack([p * (1 - p) for p in (together, *apart)]).sum().div(rollouts).sqrt() / len(x)
    assert (together - apart[0] * apart[1]).mean().abs() <= 3 * error


@pytest.mark.parametrize("kind", CONSTANTS)
def test_other_constants_are_those_of_the_suite_times_factors_of_a_half_to_two(kind):
    usual, first = kind(), drawn(kind, 1)
    for name in CONSTANTS[kind]:
        one, other = (_numbers(getattr(problem, name)) for problem in (usual, first))
        factors = other[one != 0] / one[one != 0]
        torch.testing.assert_close(factors, factors[:1].expand_as(factors))
        assert 0.5 <= factors[0] <= 2
        assert factors[0] != 1
        assert (_numbers(getattr(drawn(kind, 1), name)) == other).all()
        assert (_numbers(getattr(drawn(kind, 2), name)) != other)[one != 0].all()
        assert (_numbers(getattr(kind(), name)) == one).all()


def _numbers(constant: object) -> Tensor:
    return torch.tensor([*constant.low, *constant.high] if isinstance(constant, Box) else constant).double().reshape(-1)


def test_a_problem_with_other_constants_has_a_name():
    assert {*OTHERS} < {*PROBLEMS}
    assert PROBLEMS["DubinsCar-3"]().speed == drawn(DubinsCar, 3).speed
