"""Tables and figures of sweeps, from directories like those that Hydra and training write."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import LogNorm, Normalize
from matplotlib.image import imread
from omegaconf import OmegaConf
from small import QUICK, command

from pirl_rl.errors import RunError
from pirl_rl.run_directory import RunDirectory
from pirl_rl.runs import sweeps

CENTERS, STEEP = ("1e3", "2e3", "4000", "8e3", "16e3"), ("1e-4", "3e-4", "0.001", "3e-3", "1e-2")


def job(folder: Path, settings: dict[str, str], **summary: float) -> None:
    """A run of a multirun; one without a summary failed."""
    run = folder / str(len(list(folder.glob("*"))))
    (run / ".hydra").mkdir(parents=True)
    (run / ".hydra" / "config.yaml").write_text("experiment_name: e\nmethod_name: m\n")
    OmegaConf.save(OmegaConf.create([f"{key}={value}" for key, value in settings.items()]), RunDirectory(run).overrides)
    (run / "metrics.csv").write_text("update,td_loss\n1,1\n")
    if summary:
        (run / "summary.json").write_text(json.dumps(summary))


def mse(i: int, j: int) -> float:
    return 10.0 ** (-4 + 0.4 * abs(i - 2) + 0.6 * abs(j - 3))


@pytest.fixture
def square(tmp_path):
    """5 x 5 settings with two seeds: both runs failed in one cell, one run in another, and one cell has no runs."""
    folder = tmp_path / "square"
    for i, center in enumerate(CENTERS):
        for j, steepness in enumerate(STEEP):
            for seed in range(2):
                settings = {"+experiment": "reach1d", "schedule.center": center, "schedule.steepness": steepness}
                failed = (i, j) == (4, 0) or (i, j, seed) == (0, 0, 1)
                summary = {} if failed else {"value_mse": mse(i, j) * (1 + 0.2 * seed), "reward": 0.3}
                if (i, j) != (4, 4):
                    job(folder, {**settings, "seed": str(seed)}, **summary)
    return folder


def cells(text: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()]


def test_two_settings_make_a_table_and_a_heat_map(square, tmp_path, capsys):
    sweeps.main([str(square), "--out", str(tmp_path / "out")])
    text = (tmp_path / "out" / "sweep.md").read_text()
    assert text in capsys.readouterr().out
    header, _, *rows = cells(text)
    assert header == ["value_mse: schedule.center \\ schedule.steepness", "0.0001", "0.0003", "0.001", "0.003", "0.01"]
    assert [row[0] for row in rows] == ["1000", "2000", "4000", "8000", "16000"]
    assert rows[2][4] == f"{1.1 * mse(2, 3):.2e}"  # the mean over seeds
    assert rows[0][1] == f"{mse(0, 0):.2e} (1 of 2 failed)"
    assert rows[4][1] == "failed"
    assert rows[4][5] == "missing"
    assert imread(tmp_path / "out" / "sweep.png").std() > 0.01


def test_the_heat_map_shows_what_the_table_says(square):
    figure = sweeps.draw_sweep(sweeps.gather(sweeps.find_jobs(square), "value_mse"))
    panel = figure.axes[0]
    assert (panel.get_ylabel(), panel.get_xlabel()) == ("schedule.center", "schedule.steepness")
    shown = panel.images[0].get_array()
    assert shown.mask.sum() == 2
    assert shown[1, 2] == pytest.approx(1.1 * mse(1, 2))
    assert isinstance(panel.images[0].norm, LogNorm)
    assert {"failed", "missing", f"{1.1 * mse(1, 2):.2e}"} <= {text.get_text() for text in panel.texts}
    reward = sweeps.draw_sweep(sweeps.gather(sweeps.find_jobs(square), "reward")).axes[0].images[0]
    assert type(reward.norm) is Normalize


def test_one_setting_makes_a_line(tmp_path):
    for seed in range(2):
        for k, weight in enumerate(("0.1", "1", "10")):
            summary = {} if weight == "10" else {"value_mse": 10.0**-k}
            job(tmp_path, {"loss.weight": weight, "seed": str(seed)}, **summary)
    sweeps.main([str(tmp_path)])
    assert cells((tmp_path / "sweep.md").read_text())[2:] == [["0.1", "1.00e+00"], ["1", "1.00e-01"], ["10", "failed"]]
    panel = sweeps.draw_sweep(sweeps.gather(sweeps.find_jobs(tmp_path), "value_mse")).axes[0]
    assert (panel.get_xlabel(), panel.get_ylabel()) == ("loss.weight", "value_mse")
    assert (panel.get_xscale(), panel.get_yscale()) == ("log", "log")
    np.testing.assert_allclose(panel.lines[-1].get_data(), ([0.1, 1, 10], [1, 0.1, np.nan]))


def test_words_and_unset_settings_are_values_too(tmp_path):
    for settings in ({"method": "td3"}, {"method": "pirl"}, {}):
        job(tmp_path, settings, value_mse=1e-3)
    assert sweeps.gather(sweeps.find_jobs(tmp_path), "value_mse").axes == {"method": ["default", "pirl", "td3"]}
    sweeps.main([str(tmp_path)])


def test_three_settings_need_a_choice(tmp_path, capsys):
    for k in range(8):
        job(tmp_path, {name: str(k >> bit & 1) for bit, name in enumerate("abc")}, value_mse=1.0 + k)
    with pytest.raises(SystemExit):
        sweeps.main([str(tmp_path)])
    assert "expected one or two settings that vary beside the seed, got 3: a, b, c; choose with --axes" in (
        capsys.readouterr().err
    )
    sweeps.main([str(tmp_path), "--axes", "c", "a"])
    assert cells((tmp_path / "sweep.md").read_text())[2:] == [
        ["0", "2.00e+00", "3.00e+00"],
        ["1", "6.00e+00", "7.00e+00"],
    ]


@pytest.mark.parametrize(
    ("settings", "metric", "axes", "message"),
    [
        ({"a": "1"}, "value_mse", (), "got 0"),
        ({"a": "1"}, "nope", (), "metric: expected one of value_mse, got nope"),
        ({"a": "1"}, "value_mse", ("b",), "axes: expected settings out of a, got b"),
        ({"a": "1", "b": "1", "c": "1"}, "value_mse", ("a", "b", "c"), "expected one or two"),
    ],
)
def test_mistakes_are_named(settings, metric, axes, message, tmp_path):
    job(tmp_path, settings, value_mse=1.0)
    with pytest.raises(RunError, match=message):
        sweeps.gather(sweeps.find_jobs(tmp_path), metric, axes)


def test_no_runs_and_broken_ones_are_reported(tmp_path, capsys):
    with pytest.raises(SystemExit):
        sweeps.main([str(tmp_path / "nothing")])
    assert "no runs found below" in capsys.readouterr().err
    assert not (tmp_path / "nothing").exists()
    for content in ("a: 1\n", "[", "\0"):
        job(tmp_path, {"a": "1"}, value_mse=1.0)
        RunDirectory(tmp_path / "0").overrides.write_text(content)
        with pytest.raises(RunError, match=r"overrides\.yaml"):
            sweeps.find_jobs(tmp_path)


SMALL = ("env.num_envs=32", "collector.frames_per_batch=64", "collector.warmup_frames=64")


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["basic", "submitit_local"])
def test_a_real_sweep(launcher, tmp_path):
    """Four jobs of which two cannot begin, under each launcher: the others end, and the table knows of those."""
    if launcher != "basic":
        pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    arguments = ("-m", f"hydra/launcher={launcher}", *QUICK, *SMALL, "evaluation.during=[]")
    done = command(*arguments, "schedule.center=1,2", "seed=0,x", cwd=tmp_path)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    [folder] = tmp_path.glob("runs/*/*")
    assert len(list(folder.glob("*/summary.json"))) == 2
    done = command(str(folder), module="pirl_rl.sweeps", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (folder / "sweep.png").is_file()
    assert [row[0] for row in cells((folder / "sweep.md").read_text())[2:]] == ["1", "2"]
