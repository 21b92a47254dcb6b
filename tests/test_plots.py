"""Figures of a run and the comparison of runs: what is drawn and written, from small hand-made inputs."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
import torch
from matplotlib.image import imread

from pirl_rl.figures.comparison import draw_comparison
from pirl_rl.figures.one_dimensional import draw_value, evaluate_on_grid
from pirl_rl.figures.run import draw_run
from pirl_rl.figures.training import HELD_OUT, TRAINING, WEIGHTS, draw_training
from pirl_rl.loggers import read_metrics
from pirl_rl.networks import Actor, Critic, stack
from pirl_rl.problems import Reach1D, Safety1D
from pirl_rl.runs import compare
from pirl_rl.sets import Box
from pirl_rl.solution import Solution


class Plane(Reach1D):
    """reach1d with a second, idle coordinate."""

    states = Box([-2.0, -1.0], [2.0, 1.0])

    def drift(self, x, u):
        return torch.cat([u, torch.zeros_like(u)], -1)


def random_solution(problem) -> Solution:
    torch.manual_seed(0)
    return Solution(problem, Actor(problem), stack([Critic(problem, action_input=True) for _ in range(2)]))


def write_metrics(path, scale: float = 1.0) -> None:
    """Rows every 10 updates, held-out losses every 20."""
    names = ["update", *WEIGHTS, *TRAINING, *HELD_OUT]
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        for update in range(0, 100, 10):
            row = {"update": update} | dict.fromkeys([*WEIGHTS, *TRAINING], scale)
            writer.writerow(row | (dict.fromkeys(HELD_OUT, scale / (1 + update)) if update % 20 == 0 else {}))


@pytest.fixture
def metrics_path(tmp_path):
    write_metrics(tmp_path / "metrics.csv")
    return tmp_path / "metrics.csv"


@pytest.mark.parametrize(
    ("problem", "names"),
    [
        (Reach1D(), ["training", "surface", "value", "policy"]),
        (Safety1D(), ["training", "surface", "value", "policy"]),
        (Plane(), ["training"]),
    ],
    ids=["reach1d", "safety1d", "plane"],
)
def test_draw_run_writes_readable_figures(problem, names, metrics_path, tmp_path):
    paths = draw_run(random_solution(problem), metrics_path, tmp_path / "figures")
    assert [path.name for path in paths] == [f"{name}.png" for name in names]
    for path in paths:
        assert imread(path)[..., :3].std() > 0.01


def test_grid_holds_values_where_it_says():
    solution = random_solution(Reach1D())
    grid = evaluate_on_grid(solution, taus=5, states=9)
    tau, x = torch.tensor([grid.tau[3]]).float(), torch.tensor([[grid.x[7]]]).float()
    assert grid.value[7, 3] == pytest.approx(solution.value(tau, x).item(), abs=1e-6)
    assert grid.control[0, 7, 3] == pytest.approx(solution.policy(tau, x).item(), abs=1e-6)
    assert grid.exact[7, 3] == pytest.approx(solution.problem.exact_value(tau, x).item(), abs=1e-6)
    assert np.equal(grid.value[-1], 1).all()  # x = 2 is in the target, where V is 1 whatever the networks say


def test_value_maps_share_limits_and_are_labelled():
    figure = draw_value(evaluate_on_grid(random_solution(Reach1D()), 21, 21))
    learned, exact, error = (axes for axes in figure.axes if axes.get_title())
    assert [axes.get_title().split(",")[0] for axes in (learned, exact, error)] == ["V", "Exact V", "|error|"]
    assert learned.collections[0].get_clim() == exact.collections[0].get_clim() == (0, 1)
    assert all("(s)" in axes.get_xlabel() for axes in (learned, exact, error))
    assert len(draw_value(evaluate_on_grid(random_solution(Safety1D()), 21, 21)).axes) == 2


def test_training_curves_skip_empty_cells(metrics_path):
    metrics = read_metrics(metrics_path)
    assert np.isnan(metrics["td_loss"]).sum() == 5
    top, middle, bottom = draw_training(metrics).axes
    assert [len(axes.lines) for axes in (top, middle, bottom)] == [3, 5, 3]
    assert list(middle.lines[0].get_xdata()) == [0, 20, 40, 60, 80]
    assert top.get_yscale() == middle.get_yscale() == "log"


def make_run(folder, method: str, seed: int, **summary) -> None:
    run = folder / f"{method}-{seed}"
    (run / ".hydra").mkdir(parents=True)
    config = f"experiment_name: reach1d\nmethod_name: ${{method.name}}\nmethod: {{name: {method}}}\n"
    (run / ".hydra" / "config.yaml").write_text(config)
    (run / "summary.json").write_text(json.dumps(summary))
    write_metrics(run / "metrics.csv", scale=seed + 1)


@pytest.fixture
def runs(tmp_path):
    for seed in range(3):
        make_run(tmp_path / "runs", "pirl", seed, value_mse=1e-4 * (seed + 1), reward=0.36 + 0.01 * seed, updates=100)
    make_run(tmp_path / "runs", "td3", 0, reward=0.3, updates=100)
    return tmp_path / "runs"


def test_compare_writes_table_and_figure(runs, tmp_path, capsys):
    compare.main([str(runs), str(runs / "pirl-0"), "--out", str(tmp_path / "out")])
    text = (tmp_path / "out" / "comparison.md").read_text()
    assert text in capsys.readouterr().out
    header, _, pirl, td3 = ([cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines())
    row = dict(zip(header, pirl, strict=True))
    assert row["group"] == "reach1d pirl"
    assert row["seeds"] == "3"
    assert (row["value_mse mean"], row["value_mse worst"]) == ("2.00e-04", "3.00e-04")
    assert (row["reward mean"], row["reward min"]) == ("0.3700", "0.3600")
    assert dict(zip(header, td3, strict=True))["value_mse mean"] == "-"
    assert imread(tmp_path / "out" / "comparison.png").std() > 0.01


def test_compare_takes_the_members_of_a_population(tmp_path):
    """Its own directory has a summary and a configuration, and no rows of metrics."""
    make_run(tmp_path, "pirl", 7, value_mse=1e-4)
    (tmp_path / "pirl-7" / "metrics.csv").unlink()
    for seed in range(2):
        make_run(tmp_path / "pirl-7", "pirl", seed, value_mse=1e-4 * (seed + 1))
    assert [run.get("value_mse") for run in compare.find_runs([tmp_path])["reach1d pirl"]] == [1e-4, 2e-4]


def test_compare_keeps_problems_of_ones_own_apart(tmp_path):
    for seed, target in enumerate(("my_boats.Ferry", "my_boats.Tug", "pirl_rl.problems.Reach1D", "???")):
        make_run(tmp_path, "pirl", seed)
        with (tmp_path / f"pirl-{seed}" / ".hydra" / "config.yaml").open("a") as file:
            file.write(f"env: {{problem: {{_target_: '{target}'}}}}\n")
    groups = compare.find_runs([tmp_path])
    assert {label: len(runs) for label, runs in groups.items()} == {
        "reach1d Ferry pirl": 1,
        "reach1d Tug pirl": 1,
        "reach1d pirl": 2,
    }


def test_compare_draws_median_and_range(runs):
    figure = draw_comparison(compare.find_runs([runs]))
    axes = next(axes for axes in figure.axes if axes.get_title() == "Held-out td_loss")
    assert axes.lines[0].get_ydata()[0] == 2
    heights = axes.collections[0].get_paths()[0].vertices[:, 1]
    assert (heights.min(), heights.max()) == (pytest.approx(1 / 81), 3)


def test_compare_draws_runs_without_exact_value(tmp_path):
    """A log axis cannot be drawn without a positive value: the panels say so instead."""
    make_run(tmp_path, "td3", 0, reward=0.3)
    write_metrics(tmp_path / "td3-0" / "metrics.csv", scale=0.0)
    figure = draw_comparison(compare.find_runs([tmp_path]))
    figure.savefig(tmp_path / "comparison.png")
    assert sum(text.get_text() == "not available" for axes in figure.axes for text in axes.texts) == 6


def test_compare_reports_a_folder_without_runs(tmp_path, capsys):
    with pytest.raises(SystemExit) as stop:
        compare.main([str(tmp_path / "nothing")])
    assert stop.value.code != 0
    assert f"no runs found below {tmp_path / 'nothing'}" in capsys.readouterr().err
    assert not (tmp_path / "nothing").exists()


@pytest.mark.parametrize(
    ("file", "content", "named"),
    [
        ("summary.json", "{", "cannot be read"),
        (".hydra/config.yaml", "seed: 1\n", "experiment_name and method_name"),
        ("metrics.csv", "update\nhello\n", "cannot be read"),
    ],
)
def test_compare_names_a_broken_run(runs, capsys, file, content, named):
    (runs / "pirl-0" / file).write_text(content)
    with pytest.raises(SystemExit) as stop:
        compare.main([str(runs)])
    assert stop.value.code != 0
    message = capsys.readouterr().err
    assert named in message
    assert "pirl-0" in message
