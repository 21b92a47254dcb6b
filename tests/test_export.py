"""Exports: small directories that open like the runs from which they were made."""

from __future__ import annotations

import pytest
import torch
from small import small_trainer

from pirl_rl import load_run, train
from pirl_rl.commands.export import export, main
from pirl_rl.configuration import load_config, save_config
from pirl_rl.errors import ConfigError


@pytest.fixture
def run(tmp_path):
    trainer = small_trainer(tmp_path / "run", "trainer.updates=10")
    trainer.train()
    (tmp_path / "run" / "figures").mkdir()
    (tmp_path / "run" / "figures" / "value.png").write_bytes(b"picture")
    return tmp_path / "run"


def test_an_export_opens_like_its_run_and_is_small(run, tmp_path):
    main([f"run={run}", f"out={tmp_path / 'model'}"])
    ours, theirs = load_run(tmp_path / "model"), load_run(run)
    tau, x = torch.rand(20), 4 * torch.rand(20, 1) - 2
    assert ours.update == theirs.update == 10
    assert torch.equal(ours.value(tau, x), theirs.value(tau, x))
    assert torch.equal(ours.policy(tau, x), theirs.policy(tau, x))
    names = {str(path.relative_to(tmp_path / "model")) for path in (tmp_path / "model").rglob("*") if path.is_file()}
    weights = "checkpoints/weights-000000010.pt"
    assert names == {".hydra/config.yaml", "summary.json", "metrics.csv", "figures/value.png", weights}
    assert (tmp_path / "model" / weights).stat().st_size < (run / "checkpoints" / "last.pt").stat().st_size / 2


def test_where_the_run_started_from_is_not_told(run, tmp_path):
    config = load_config(run)
    config.start = str(tmp_path / "before")
    save_config(config, run)
    export(run, tmp_path / "model")
    exported = load_config(tmp_path / "model")
    assert exported.start is None
    assert {**exported, "start": config.start} == dict(config)
    assert str(tmp_path) not in (tmp_path / "model" / ".hydra" / "config.yaml").read_text()


def test_nothing_is_overwritten(run, tmp_path):
    (tmp_path / "model").mkdir()
    with pytest.raises(ConfigError, match="model exists"):
        export(run, tmp_path / "model")
    assert not list((tmp_path / "model").iterdir())


@pytest.mark.parametrize("arguments", [[], ["run=a"], ["run=a", "out=b", "more=c"], ["run=a", "out=b", "c"]])
def test_the_command_says_what_it_expects(arguments, capsys):
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    assert stop.value.code == 1
    assert "expected run=RUN_DIR out=FOLDER" in capsys.readouterr().err


def test_help_is_the_docstring(capsys):
    main(["--help"])
    assert "python -m pirl_rl.export run=RUN_DIR out=FOLDER" in capsys.readouterr().out


def test_an_export_is_not_trained_from_the_beginning(run, tmp_path, in_process):
    export(run, tmp_path / "model")
    before = {path: path.read_bytes() for path in (tmp_path / "model").rglob("*") if path.is_file()}
    code, text = in_process(train)(f"resume={tmp_path / 'model'}")
    assert code == 1
    assert f"start={tmp_path / 'model'} begins another run" in text
    assert {path: path.read_bytes() for path in before} == before
