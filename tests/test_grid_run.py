"""method=grid: a run directory like any other, from the command and from Python."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

import pirl_rl
from pirl_rl.commands.export import export
from pirl_rl.commands.train import resume
from pirl_rl.errors import ArgumentError, CheckpointError, ConfigError
from pirl_rl.grid import GridSolution, GridSolver
from pirl_rl.problems import CartPole, DubinsCar, HalfSpace, Reach1D, ZermeloBoat
from pirl_rl.runs.compare import find_runs

SMALL = {"grid": {"points": 81}, "env.dt": 0.02}
SMALL |= {
    "evaluation": {
        "success": {"episodes": 500},
        "calibration": {"points": 20, "rollouts": 100},
        "slices": {"points": 5, "rollouts": 2},
        "verdict": {"points": 100, "rollouts": 32},
    }
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("grid") / "run"


@pytest.fixture(scope="module")
def run(folder):
    return pirl_rl.train("reach1d", method="grid", folder=folder, **SMALL)


def test_a_grid_leaves_a_run_directory(run, folder):
    summary = json.loads((folder / "summary.json").read_text())
    assert 0 < summary["grid_error"] < 0.05
    assert summary["masked_value_mse"] < 1e-3
    assert 0.3 < summary["success_rate"] < 0.9
    assert {path.name for path in (folder / "figures").iterdir()} == {
        "surface.png",
        "value.png",
        "policy.png",
        "calibration.png",
    }
    assert summary["verdict"] == "solved"
    assert summary["verdict_lines"].startswith("verdict   solved: ")
    assert "method=grid" in (folder / "report.html").read_text()


def test_its_run_answers_like_any_other(run, folder):
    """V within 0.005 of the closed form, and Monte Carlo within four standard errors of 400 paths."""
    x = np.linspace(-1.9, 1.9, 20)[:, None]
    again = pirl_rl.load_run(folder)
    assert np.array_equal(again.value(1.5, x), run.value(1.5, x))
    assert np.array_equal(again.policy(1.5, x), run.policy(1.5, x))
    exact = Reach1D().exact_value(torch.full((20,), 1.5, dtype=torch.float64), torch.from_numpy(x))
    assert np.abs(run.value(1.5, x) - exact.numpy()).max() < 5e-3
    slope = (run.value(1.5, x + 0.02) - run.value(1.5, x - 0.02)) / 0.04
    assert np.abs(run.gradient(1.5, x)[:, 0] - slope).max() < 0.05
    estimate = run.monte_carlo(1.5, x, rollouts=400)
    assert np.abs(estimate.probability - run.value(1.5, x)).max() < 4 * 0.5 / 400**0.5
    assert run.simulate(1.5, x, seed=1).state.shape[1:] == (20, 1)


@pytest.mark.parametrize("problem", [HalfSpace(dim=2), DubinsCar(), ZermeloBoat()], ids=lambda p: type(p).__name__)
def test_a_solution_survives_its_file(problem, tmp_path):
    solution = GridSolver(problem, 11).solve()
    solution.save(tmp_path / "grid.npz")
    loaded = GridSolution.load(tmp_path / "grid.npz", problem)
    rng = torch.Generator().manual_seed(0)
    x, tau = problem.states.sample(50, rng, torch.float64), problem.horizon * torch.rand(50, generator=rng)
    for name in ("value", "policy", "error", "gradient"):
        assert torch.equal(getattr(loaded, name)(tau, x), getattr(solution, name)(tau, x)), name


def test_what_a_grid_cannot_do_is_said(run, folder, tmp_path, capsys):
    with pytest.raises(ArgumentError, match="residual: a grid has none"):
        run.residual(1.0, np.zeros((1, 1)))
    with pytest.raises(ArgumentError, match="lookahead=0"):
        run.policy(1.0, np.zeros((1, 1)), lookahead=2)
    with pytest.raises(ConfigError, match="expected at most 3 states for a grid, got 4"):
        pirl_rl.train(CartPole, method="grid", folder=tmp_path / "cartpole")
    assert not (tmp_path / "cartpole").exists()
    with pytest.raises(ConfigError, match=r"evaluation\.final"):
        pirl_rl.train("reach1d", method="grid", folder=tmp_path / "typo", **{"evaluation.final": ["succes"]})
    assert not (tmp_path / "typo").exists()
    with pytest.raises(SystemExit):
        resume(folder, [])
    assert "holds the solution of a grid" in capsys.readouterr().err


def test_a_grid_is_exported_and_compared(run, folder, tmp_path):
    x = np.linspace(-1.9, 1.9, 20)[:, None]
    assert export(folder, tmp_path / "copy") == tmp_path / "copy" / "grid.npz"
    assert np.array_equal(pirl_rl.load_run(tmp_path / "copy").value(1.5, x), run.value(1.5, x))
    (groups,) = find_runs([tmp_path]).values()
    assert groups[0].get("success_rate") == json.loads((folder / "summary.json").read_text())["success_rate"]
    (tmp_path / "copy" / "grid.npz").unlink()
    with pytest.raises(CheckpointError, match="no grid at"):
        export(tmp_path / "copy", tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_a_broken_or_foreign_file_is_refused(tmp_path):
    GridSolver(HalfSpace(dim=2), 11).solve().save(tmp_path / "grid.npz")
    with pytest.raises(CheckpointError, match="expected 1 states and 1 controls, got 2 and 2"):
        GridSolution.load(tmp_path / "grid.npz", Reach1D())
    (tmp_path / "grid.npz").write_bytes((tmp_path / "grid.npz").read_bytes()[:1000])
    with pytest.raises(CheckpointError, match="expected the values of a grid"):
        GridSolution.load(tmp_path / "grid.npz", HalfSpace(dim=2))
    with pytest.raises(CheckpointError, match="expected the values of a grid"):
        GridSolution.load(tmp_path / "nothing.npz", HalfSpace(dim=2))


FEW = {"debug": "default", "env.dt": 0.05, "figures": False, "evaluation": {"during": [], "final": []}}


def test_a_look_ahead_reaches_what_the_actor_does_not(tmp_path):
    """With a reversed actor, one control step through the model finds the best control of the exact value."""
    run = pirl_rl.train("reach1d", folder=tmp_path / "run", updates=1, **FEW)
    x = torch.linspace(-1.5, 1.5, 30).unsqueeze(-1)
    problem = run.problem
    run.solution.value = lambda tau, state: problem.exact_value(tau, state)
    best = problem.optimal_control(torch.full((30,), 1.0), x)
    run.solution.policy = lambda tau, state: -problem.optimal_control(tau, state)
    assert torch.equal(run.policy(1.0, x), -best)
    assert torch.equal(run.policy(1.0, x, lookahead=1), best)
    for lookahead, levels in ((-1, 5), (1.5, 5), (1, 1)):
        with pytest.raises(ArgumentError, match="policy: expected integers lookahead >= 0 and levels >= 2"):
            run.policy(1.0, x, lookahead=lookahead, levels=levels)
