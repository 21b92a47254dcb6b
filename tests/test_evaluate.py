"""`python -m pirl_rl.evaluate`: the same run measured again, with the samples that were asked for."""

from __future__ import annotations

import errno
import json
import os

import pytest
from small import small_trainer

from pirl_rl import evaluate, load_run
from pirl_rl.commands import certify  # reads the arguments of Run.certify, which a test replaces
from pirl_rl.errors import ConfigError
from pirl_rl.run_directory import RunDirectory

FIGURES = {"training.png", "surface.png", "value.png", "policy.png"}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return folder, small_trainer(folder, "evaluation.final=[exact,success]").train()


def test_repeats_the_summary(run, capsys):
    folder, summary = run
    evaluate.main([f"run={folder}"])
    results = json.loads((folder / "evaluation.json").read_text())
    settings = results.pop("settings")
    assert results == {name: summary[name] for name in results}
    assert settings["success"]["episodes"] == 64
    assert (settings["simulator"]["dt"], settings["simulator"]["substeps"]) == (0.1, 1)
    assert "value_mse" in results
    printed = capsys.readouterr().out
    assert "value_mse" in printed
    assert {path.name for path in (folder / "figures").iterdir()} == FIGURES
    assert all(name in printed for name in FIGURES)


def test_takes_other_samples(run):
    folder, summary = run
    evaluate.main([f"run={folder}", "evaluation.final=[success]", "evaluation.success.episodes=2000", "figures=false"])
    results = json.loads((folder / "evaluation.json").read_text())
    width, before = (entry["success_high"] - entry["success_low"] for entry in (results, summary))
    assert "value_mse" not in results
    assert {*results["settings"]} == {"problem", "simulator", "success"}
    assert results["settings"]["success"]["episodes"] == 2000
    assert results["settings"]["success"]["seed"] == load_run(folder).config.evaluation.success.seed
    assert width < before / 2  # 2,000 episodes against the debug configuration's 64


def test_a_run_of_an_earlier_version_has_no_verbose(run, capsys):
    folder = run[0]
    config = RunDirectory(folder).config
    config.write_text("".join(line for line in config.read_text().splitlines(True) if not line.startswith("verbose")))
    few = [f"run={folder}", "evaluation.final=[success]", "evaluation.success.episodes=50", "figures=false"]
    evaluate.main(few)
    evaluate.main([*few, "verbose=true"])
    assert "success_rate" in capsys.readouterr().out


def test_words_for_false_are_false(run, capsys):
    few = [f"run={run[0]}", "evaluation.final=[success]", "evaluation.success.episodes=50", "report=off", "verbose=no"]
    evaluate.main(few)
    printed = capsys.readouterr().out
    assert "report " not in printed
    assert "figure " in printed
    evaluate.main([*few, "figures=no"])
    assert "figure " not in capsys.readouterr().out
    with pytest.raises(SystemExit):
        evaluate.main([*few, "report=perhaps"])
    assert "report: expected bool, got 'perhaps'" in capsys.readouterr().err


def test_draws_nowhere_else(run, tmp_path, capsys):
    """A link in a directory from elsewhere is not followed."""
    folder = run[0]
    link = folder / "extra"
    link.symlink_to(tmp_path)
    with pytest.raises(SystemExit):
        evaluate.main([f"run={folder}"])
    link.unlink()
    assert "leads out of the run directory" in capsys.readouterr().err


@pytest.mark.parametrize("command", [evaluate, certify])
def test_a_directory_that_cannot_be_written_is_refused_before_the_work(command, run, monkeypatch, capsys):
    """An administrator can write everywhere, so that the refusal of the operating system is imitated."""

    def refuse(dir):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(dir))

    def work(*arguments, **settings):
        raise AssertionError("the work has begun")

    monkeypatch.setattr("pirl_rl.run_directory.tempfile.TemporaryFile", refuse)
    monkeypatch.setattr("pirl_rl.commands.evaluate.evaluate", work)
    monkeypatch.setattr("pirl_rl.runs.run.Run.certify", work)
    with pytest.raises(SystemExit) as stop:
        command.main([f"run={run[0]}"])
    assert stop.value.code == 1
    assert f"{run[0]}: expected a directory that can be written" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ([], "run=RUN_DIR"),
        (["run=nowhere"], "nowhere is not a run directory"),
        (
            ["run={folder}", "run=other"],
            "run: expected run=RUN_DIR once, the directory of a finished run, got {folder} and other",
        ),
        (["run={folder}", "evaluation.success.episods=3"], "episods"),
        (["run={folder}", "evaluation.final=[excat]"], "excat"),
        (["run={folder}", "evaluation.success._target_=os.system"], "os.system"),
    ],
)
def test_mistakes_are_named(arguments, told, run, capsys):
    with pytest.raises(SystemExit) as stop:
        evaluate.main([argument.format(folder=run[0]) for argument in arguments])
    assert stop.value.code == 1
    assert told.format(folder=run[0]) in capsys.readouterr().err


def test_help_is_the_docstring(capsys):
    evaluate.main(["--help"])
    assert "python -m pirl_rl.evaluate run=RUN_DIR" in capsys.readouterr().out


def test_a_changed_problem_is_the_one_that_is_measured(run, capsys):
    """Within a tenth of the horizon hardly any path reaches the target."""
    folder, summary = run
    evaluate.main([f"run={folder}", "evaluation.final=[success]", "env.problem.horizon=0.2", "figures=false"])
    results = json.loads((folder / "evaluation.json").read_text())
    assert results["success_rate"] < summary["success_rate"] / 2
    assert results["settings"]["problem"]["horizon"] == 0.2
    with pytest.raises(SystemExit):
        evaluate.main([f"run={folder}", "actor.hidden=[7]"])
    assert "actor.hidden=[7]: expected a setting of another group" in capsys.readouterr().err
    opened = load_run(folder)
    for typed in ({"env.problem.horizon": 0.2}, {"critic.hidden": [7]}):
        with pytest.raises(ConfigError, match=r"load_run\(folder, problem=...\) opens it with another problem"):
            evaluate(opened, **typed)


def test_ctrl_c_ends_the_command_with_its_exit_code(run, monkeypatch, capsys):
    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr("pirl_rl.commands.evaluate.evaluate", interrupted)
    with pytest.raises(SystemExit) as stop:
        evaluate.main([f"run={run[0]}"])
    assert stop.value.code == 130
    assert capsys.readouterr().err.endswith("stopped\n")
