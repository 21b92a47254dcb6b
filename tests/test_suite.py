"""The suite: truths, scores against known answers, the table, and the command, which goes on where it stopped."""

from __future__ import annotations

import json
import math
import re
import shutil
from dataclasses import asdict

import pytest
import torch

from pirl_rl.commands.suite import main
from pirl_rl.figures import draw_suite
from pirl_rl.problems import CartPole, Exit1D, Pendulum, Reach1D, VehicleDrift3
from pirl_rl.scoring import PROBLEMS, Score, Truth, find_truth, markdown, measure
from pirl_rl.scoring.truth import DOUBT
from pirl_rl.simulator import Simulator

SMALL = ["problems=[exit1d]", "states=50", "rollouts=20", "+debug=default", "evaluation.final=[]", "figures=false"]
SMALL += ["env.dt=0.1", "env.substeps=1", "evaluation.during=[]"]


class Exact:
    """A solution with the exact value and the best control, and V shifted by a number."""

    dtype = torch.float64

    def __init__(self, problem, shift=0.0):
        self.problem, self.shift = problem, shift

    def value(self, tau, x):
        return self.problem.exact_value(tau, x) + self.shift

    def policy(self, tau, x):
        return self.problem.optimal_control(tau, x)


def test_every_problem_of_the_suite_has_states_and_a_source():
    assert len({overrides[0] for overrides in PROBLEMS.values()}) >= 12
    assert find_truth(Exit1D(), 100, 0).source == "exact"
    # Four states, and three states with two controls, are too many for the grid.
    for problem in (CartPole(), VehicleDrift3()):
        none = find_truth(problem, 10, 0)
        assert (none.source, none.value) == ("none", None)


def test_the_grid_is_the_truth_where_no_closed_form_is_known(monkeypatch):
    monkeypatch.setattr("pirl_rl.scoring.truth.GRID_POINTS", {2: 61})
    truth = find_truth(Pendulum(), 100, 0)
    assert truth.source == "grid"
    assert 0 < truth.error < 0.1
    assert ((truth.value >= -1e-6) & (truth.value <= 1 + 1e-6)).all()


class PartlySure:
    """A grid that vouches for the states with a first coordinate below a bound."""

    bound, resolves_target = 0.0, True

    def __init__(self, problem, points):
        pass

    def solve(self):
        return self

    def value(self, tau, x):
        return x[:, 0]

    def error(self, tau, x):
        return 2 * DOUBT * (x[:, 0] > self.bound)


def test_states_at_which_the_grid_is_in_doubt_are_replaced(monkeypatch):
    """It vouches for about three quarters of the 200 states that are drawn for 100."""
    monkeypatch.setattr("pirl_rl.scoring.truth.GridSolver", PartlySure)
    monkeypatch.setattr(PartlySure, "bound", Pendulum.states.high[0] / 2)
    truth = find_truth(Pendulum(), 100, 0)
    assert len(truth.x) == 100
    assert (truth.x[:, 0] <= PartlySure.bound).all()
    assert torch.equal(truth.value, truth.x[:, 0])


def test_a_grid_that_is_in_doubt_at_most_states_is_no_truth(monkeypatch):
    monkeypatch.setattr("pirl_rl.scoring.truth.GridSolver", PartlySure)
    monkeypatch.setattr(PartlySure, "bound", Pendulum.states.low[0] / 2)
    truth = find_truth(Pendulum(), 100, 0)
    assert (truth.source, truth.value) == ("none", None)
    assert len(truth.x) == 100


def test_states_are_reproducible_and_outside_the_sets():
    one, other = (find_truth(Reach1D(), 200, seed=5) for _ in range(2))
    assert torch.equal(one.x, other.x)
    assert Reach1D().interior(one.x).all()
    assert (one.tau >= 0.1 * Reach1D().horizon).all()


def test_scores_of_the_exact_solution():
    """Within four standard errors; Monte Carlo has 100 x 400 paths."""
    problem = Reach1D()
    truth, simulator = find_truth(problem, 100, 0), Simulator(problem, 0.05)
    score = measure(Exact(problem), simulator, truth, 400, 12.0, 7)
    assert score.mse < 1e-12
    assert abs(score.loss) < 4 * score.loss_error
    assert score.gap == pytest.approx(score.gap_noise, rel=0.2)
    # The largest of 20 losses, each with a standard error of at most 0.5 / sqrt(4000).
    assert abs(score.largest_loss) < 4 * 0.5 / 4000**0.5
    assert (score.seconds, score.updates) == (12.0, 7)
    shifted = measure(Exact(problem, 0.1), simulator, truth, 50, 0.0, 0)
    assert shifted.mse == pytest.approx(0.01)
    assert shifted.gap > 0.08


def test_scores_without_a_truth_are_not_numbers():
    problem = Reach1D()
    truth = find_truth(problem, 20, 0)
    score = measure(Exact(problem), Simulator(problem, 0.1), Truth(truth.tau, truth.x, None, "none"), 10, 0.0, 0)
    assert math.isnan(score.mse)
    assert math.isnan(score.largest_loss)
    assert 0 <= score.success <= 1
    row = markdown({"p": [score, score]}, {"p": "none"}).splitlines()[-1]
    assert "nan" not in row
    assert "| none | 2 |" in row


def test_the_table_names_the_worst_seed():
    def score(mse, success):
        rest = dict.fromkeys(("mean_error", "largest_error", "loss", "loss_error", "largest_loss"), 0.0)
        return Score(mse=mse, success=success, **rest, gap=0.0, gap_noise=0.0, seconds=60.0, updates=1)

    row = markdown({"p": [score(1e-4, 0.5), score(3e-4, 0.4)]}, {"p": "exact"}).splitlines()[-1]
    assert "| 2.0e-04 (3.0e-04) |" in row
    assert "| 0.450 (0.400) |" in row


def test_one_seed_has_the_standard_error_of_its_loss():
    rest = dict.fromkeys(("mean_error", "largest_error", "largest_loss", "gap", "gap_noise", "seconds"), 0.0)
    score = Score(mse=1e-4, success=0.5, loss=0.002, loss_error=0.0007, **rest, updates=1)
    assert "| 0.0020 ± 0.0007 |" in markdown({"p": [score]}, {"p": "exact"})
    assert "±" not in markdown({"p": [score, score]}, {"p": "exact"})


def test_a_score_survives_its_file(tmp_path):
    """Also the entries without a truth, which are not numbers."""
    rest = dict.fromkeys(("mse", "mean_error", "largest_error", "loss", "loss_error", "largest_loss"), math.nan)
    score = Score(success=0.1 + 0.2, **rest, gap=1e-17, gap_noise=0.0, seconds=60.5, updates=7)
    score.save(tmp_path / "new" / "score.json")
    again = Score.load(tmp_path / "new" / "score.json")
    assert repr(again) == repr(score)  # numbers that are not numbers are not equal


def test_the_command_goes_on_where_it_stopped(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    main([*SMALL, "seeds=[3]"])
    first = json.loads((tmp_path / "runs/suite/exit1d/3/score-50-20.json").read_text())
    assert first["updates"] == 20
    assert (tmp_path / "runs/suite/suite.png").is_file()
    capsys.readouterr()
    (tmp_path / "runs/suite/exit1d/4/checkpoints").mkdir(parents=True)  # a run that was killed early
    shutil.copytree(tmp_path / "runs/suite/exit1d/3", tmp_path / "runs/suite/exit1d/3-backup")
    main([*SMALL, "seeds=[3,4]"])
    assert json.loads((tmp_path / "runs/suite/exit1d/3/score-50-20.json").read_text()) == first
    printed = capsys.readouterr().out
    assert "seed=4" in printed
    assert "seed=3" not in printed
    assert (tmp_path / "runs/suite/suite.md").read_text().strip() in printed
    main([*SMALL, "seeds=[3]", "rollouts=40"])
    again = json.loads((tmp_path / "runs/suite/exit1d/3/score-50-40.json").read_text())
    assert again["mse"] == first["mse"]
    assert again["gap_noise"] < first["gap_noise"]
    main([*SMALL, "seeds=[3]", "draw=1"])
    elsewhere = json.loads((tmp_path / "runs/suite/exit1d/3/score-50-draw1-20.json").read_text())
    assert elsewhere["seconds"] == first["seconds"], "a run is measured at other states without being trained again"
    draws = [torch.load(tmp_path / f"runs/suite/exit1d/truth-50{end}.pt")["x"] for end in ("", "-draw1")]
    assert not any(torch.isin(*draws))
    with pytest.raises(SystemExit):
        main([*SMALL, "seeds=[3]", "trainer.updates=30"])
    assert re.search(r"out: expected a new directory.*trainer\.updates=30", capsys.readouterr().err)
    with pytest.raises(SystemExit):
        main([*SMALL, "seeds=[5]", "env.problem.horizon=0.5"])
    assert re.search(r"out: .*truth-50\.pt is the truth of the problem with no settings", capsys.readouterr().err)


def test_the_table_and_the_figure_have_all_runs_of_the_folder(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    drawn: list = []
    monkeypatch.setattr(
        "pirl_rl.commands.suite.draw_suite", lambda scores: (drawn.append(scores), draw_suite(scores))[1]
    )
    other = ["problems=[reach1d]", *SMALL[1:]]
    for arguments in ([*SMALL, "seeds=[10]"], [*SMALL, "seeds=[9]"], [*other, "seeds=[1]"], [*other, "rollouts=10"]):
        main(arguments)
    assert [{name: len(runs) for name, runs in scores.items()} for scores in drawn] == [
        {"exit1d": 1},
        {"exit1d": 2},
        {"reach1d": 1, "exit1d": 2},
        {"reach1d": 1},  # the only run with ten rollouts
    ]
    scores = [json.loads((tmp_path / f"runs/suite/exit1d/{seed}/score-50-20.json").read_text()) for seed in (9, 10)]
    assert drawn[1]["exit1d"] == scores


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["problems=[nowhere]"], "problems: expected names out of reach1d, .* got 'nowhere'"),
        (["seeds=3"], "seeds: expected a list"),
        (["problems=[exit1d]", "against=[mpc]"], "against: expected names out of grid, lqr, ppo, sac, got 'mpc'"),
        (["problems=[exit1d]", "patience=0"], "patience: expected a number > 0, got 0"),
        (["problems=[exit1d]", "rollouts=0"], "rollouts: expected integers >= 1, got 0"),
        (["problems=[exit1d]", "draw=-1"], "draw: expected integers >= 0, got -1"),
        (["problems=[exit1d]", "trainer.update=3"], "update"),
    ],
)
def test_mistakes_are_named(arguments, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main(arguments)
    assert re.search(message, capsys.readouterr().err)
    assert not any(tmp_path.iterdir())


def test_alternatives_stand_in_the_table_and_are_kept(tmp_path, capsys, monkeypatch):
    """The grid is timed, the regulator is played, and neither is repeated by a second call."""
    monkeypatch.chdir(tmp_path)
    asked = ["problems=[double_integrator]", "states=30", "rollouts=10", *SMALL[3:]]
    monkeypatch.setattr("pirl_rl.scoring.truth.GRID_POINTS", {2: 41})
    monkeypatch.setattr("pirl_rl.scoring.alternatives.GRID_POINTS", {2: 41})
    main([*asked, "against=[grid,lqr]"])
    table = (tmp_path / "runs/suite/suite.md").read_text().splitlines()
    assert table[0].endswith("| Time of the grid | Success of LQR |")
    found = json.loads((tmp_path / "runs/suite/double_integrator/lqr-30-10-10.json").read_text())
    assert table[2].endswith(f"| {found['success']:.3f} |")
    assert 0 < found["success"] <= 1
    assert re.search(r"\| \d+\.\d s \|", table[2])
    capsys.readouterr()
    main([*asked, "against=[grid,lqr]"])
    assert "double_integrator: lqr" not in capsys.readouterr().out


def test_a_figure_of_problems_without_a_truth():
    score = Score(*[math.nan] * 3, 0.5, math.nan, 0.01, math.nan, 0.02, 0.01, 60.0, 12_000)
    assert len(draw_suite({"cartpole": [asdict(score)]}).axes) == 3


def test_a_figure_has_times_of_problems_that_come_in_several_dimensions():
    score = Score(1e-4, 0.01, 0.1, 0.5, 0.002, 0.001, 0.02, 0.01, 0.009, 60.0, 12_000)
    figure = draw_suite({f"halfspace-{n}": [asdict(score), asdict(score) | {"seconds": 50.0 + n}] for n in (2, 8)})
    mse, _, gap, times = figure.axes
    assert mse.get_xlim() == pytest.approx((1e-5, 1e-3)), "whole decades, the margin beside 1e-4 among them"
    assert times.lines[0].get_xdata().tolist() == [2, 8]
    assert list(times.lines[0].get_ydata()) == [52.0, 58.0]
    assert times.get_ylim()[1] > 60
    assert [0.009, 0.009] in [list(line.get_xdata()) for line in gap.lines]
    alone = {f"{family}-2": [asdict(score)] for family in ("halfspace", "radial_exit")}
    assert len(draw_suite(alone).axes) == 3, "times of one number of states"


def test_files_in_the_place_of_a_run_stay(tmp_path, capsys):
    mine = tmp_path / "exit1d" / "0" / "thesis.txt"
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    with pytest.raises(SystemExit):
        main([*SMALL, "seeds=[0]", f"out={tmp_path}"])
    assert "expected an empty directory" in capsys.readouterr().err
    assert mine.read_text() == "mine"


def test_a_foreign_run_imports_nothing_that_the_command_does_not_trust(tmp_path, capsys):
    main([*SMALL, "seeds=[0]", f"out={tmp_path}", "trainer.updates=2"])
    config = tmp_path / "exit1d" / "0" / ".hydra" / "config.yaml"
    text = config.read_text()
    assert "pirl_rl.problems.Exit1D" in text
    text = text.replace("pirl_rl.problems.Exit1D", "subprocess.getoutput")
    config.write_text(re.sub(r"(?m)^trust:.*$", "trust: [subprocess]", text))
    next(config.parent.parent.glob("score-*.json")).unlink()
    with pytest.raises(SystemExit):
        main([*SMALL, "seeds=[0]", f"out={tmp_path}", "trainer.updates=2"])
    assert "subprocess.getoutput is outside pirl_rl" in capsys.readouterr().err
