"""The names of a run directory's files, and which checkpoint is its newest."""

from __future__ import annotations

from pathlib import Path

import pytest

from pirl_rl.errors import CheckpointError, ConfigError
from pirl_rl.run_directory import RunDirectory


def test_names(tmp_path):
    run = RunDirectory(tmp_path)
    paths = (run.config, run.overrides, run.metrics, run.summary, run.evaluation, run.last, run.weights(7), run.figures)
    assert [str(path.relative_to(tmp_path)) for path in paths] == [
        *(".hydra/config.yaml", ".hydra/overrides.yaml", "metrics.csv", "summary.json", "evaluation.json"),
        *("checkpoints/last.pt", "checkpoints/weights-000000007.pt", "figures"),
    ]
    assert not list(tmp_path.iterdir())
    assert (str(run), Path(run)) == (str(tmp_path), tmp_path)
    assert RunDirectory.of_checkpoint(run.last).path == tmp_path


def test_newest(tmp_path):
    run = RunDirectory(tmp_path)
    assert run.newest() == run.last
    run.checkpoints.mkdir()
    for update in (5, 100_000, 20):
        run.weights(update).touch()
    assert run.newest() == run.weights(100_000)
    run.last.touch()
    assert run.newest() == run.last


def test_checkpoints_by_name_are_the_run_s_own(tmp_path):
    run = RunDirectory(tmp_path)
    assert run.checkpoint("last.pt") == run.last
    for name in ("../last.pt", "/last.pt", "", ".."):
        with pytest.raises(CheckpointError, match="expected the name of a file"):
            run.checkpoint(name)


def test_links_that_lead_out_are_refused(tmp_path):
    run = RunDirectory(tmp_path / "run")
    run.figures.mkdir(parents=True)
    (run.path / "inner").symlink_to(run.figures)
    run.refuse_links()
    (run.figures / "outer").symlink_to(tmp_path)
    with pytest.raises(ConfigError, match=r"figures/outer: expected no link that leads out of the run directory"):
        run.refuse_links()


def test_the_logs_of_a_logging_service_may_be_links(tmp_path):
    logs = tmp_path / "run" / "wandb" / "offline-run-1" / "logs"
    logs.mkdir(parents=True)
    (logs / "debug-core.log").symlink_to(tmp_path / "cache" / "core.log")
    RunDirectory(tmp_path / "run").refuse_links()
    (tmp_path / "run" / "wandb" / "cache").symlink_to(tmp_path)
    with pytest.raises(ConfigError, match="expected no link that leads out"):
        RunDirectory(tmp_path / "run").refuse_links()
