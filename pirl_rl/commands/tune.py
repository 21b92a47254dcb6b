"""Continue a run in rounds, each planned by an advisor.

    python -m pirl_rl.tune +experiment=NAME start=RUN_DIR [advisor=NAME] [rounds=3] [candidates=2] [key=value ...]
    python -m pirl_rl.tune --report out=DIR

A command with the `out` of a stopped loop resumes that loop. --report writes the report of a loop, finished or not,
without training. The candidates have the method of the start, unless another one is given.

    start       the run directory, or a file in its checkpoints/
    advisor     plans the rounds; `python -m pirl_rl` lists the advisors
    rounds      the number of rounds
    candidates  the number of candidates in each round
    updates     the number of updates of each candidate
    parallel    the number of candidates that are trained at a time, each in a process of its own
    population  true trains the candidates of a round side by side in one process, for devices with many cores
    out         the directory of the loop
    key=value   any other setting goes to the training of all candidates

Examples:
    python -m pirl_rl.tune +experiment=reach1d start=runs/reach1d/2026-01-31_12-00-00-0 updates=4000
    python -m pirl_rl.tune +experiment=drift start=models/drift advisor=optuna rounds=5 out=runs/my_search
"""

from __future__ import annotations

import contextlib
import shlex
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from pirl_rl.assembly import make_trainer
from pirl_rl.building import build, convert
from pirl_rl.commands.baseline import measure
from pirl_rl.commands.composition import OTHER_FOLDERS, check_overrides, compose, drop_leftovers, register
from pirl_rl.commands.console import named_modules, quiet_libraries, reported
from pirl_rl.commands.loop_settings import counts_of, overrides_of_training, readable
from pirl_rl.commands.start import absolute_start, adopt_networks
from pirl_rl.configuration import CONF
from pirl_rl.continuation import start_from
from pirl_rl.errors import INTERRUPTED, ConfigError
from pirl_rl.files import remove_folder, replacing
from pirl_rl.outer_loop.candidates import LEADING, Task, quoted, training_overrides
from pirl_rl.outer_loop.directory import SETTINGS_FILE, check_directory, locked
from pirl_rl.outer_loop.history import Result, tolerance
from pirl_rl.outer_loop.loop import Loop, LoopSettings
from pirl_rl.outer_loop.plan import START, Candidate
from pirl_rl.outer_loop.processes import Processes
from pirl_rl.outer_loop.record import Record
from pirl_rl.outer_loop.redaction import redact
from pirl_rl.outer_loop.report import markdown, write_report
from pirl_rl.outer_loop.together import Together
from pirl_rl.progress import helped
from pirl_rl.run_directory import RunDirectory
from pirl_rl.trainer import Trainer

JUDGES = ("success", "residuals", "calibration")
"""Evaluators that the baseline and the candidates are compared by."""


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="tune")
def tune(config: DictConfig) -> None:
    """Start or resume the loop in `out`."""
    typed = HydraConfig.get().overrides.task
    absolute_start(config)
    out = Path(HydraConfig.get().runtime.output_dir)
    with reported(out), _tidy(out), _resumable(out):
        counts = counts_of(config)
        if convert(config.population, bool, "population") and counts["parallel"] > 1:
            raise ConfigError(
                f"parallel: expected 1 with population=true, which is one process, got {counts['parallel']}"
            )
        train = overrides_of_training(config, typed)
        trust = named_modules(typed, config.trust)
        advisor = build(config.advisor, "advisor", trust)
        trainer, path, final = _first(config, train, trust)
        config.start = str(path)
        kept = redact(OmegaConf.to_container(config, resolve=True))
        check_directory(out, kept)
        with locked(out) as lock:
            check_directory(out, kept)
            if not (out / SETTINGS_FILE).exists():
                with replacing(out / SETTINGS_FILE) as file:
                    file.write(OmegaConf.to_yaml(OmegaConf.create(kept)))
            record = Record(out)
            baseline = record.baseline()
            if baseline is None:
                print(f"baseline: evaluating {path}", flush=True)
                baseline = measure(trainer, path, trust)
                record.write_baseline(baseline)
            del trainer  # frees its memory for the candidates
            parallel = counts.pop("parallel")
            settings = LoopSettings(**counts, start=path, train=train, trust=trust, final=final, seed=config.seed)
            processes = Processes(parallel, [lock])
            loop = Loop(settings, record, advisor, Together(processes) if config.population else processes)
            loop.run(record.history(baseline, tolerance(baseline)))
            _report(out, path)


def report(out: Path) -> None:
    """Write the report of a loop, finished or not."""
    with reported(out):
        RunDirectory(out).refuse_links()
        if not (out / SETTINGS_FILE).is_file():
            raise ConfigError(f"out: expected a directory with {SETTINGS_FILE}, which a loop writes, got {out}")
        settings = OmegaConf.to_container(OmegaConf.load(out / SETTINGS_FILE), resolve=False)
        _report(out, Path(str(settings["start"])))  # type: ignore[index, call-overload]


def _report(out: Path, start: Path) -> None:
    record = Record(out)
    baseline = record.baseline()
    if baseline is None:
        raise ConfigError(f"out: expected a loop with a measured baseline, got none in {out}")
    history = record.history(baseline, tolerance(baseline))
    print(f"\n{markdown(history)}")
    for path in write_report(history, out):
        print(f"written  {path}")
    best = history.best
    print(f"best     {start if best.candidate is None else record.run(str(best.checkpoint))}")


def _first(config: DictConfig, train: Sequence[str], trust: Sequence[str]) -> tuple[Trainer, Path, list[str]]:
    """The trainer of a candidate with the networks of the start, the file of the start, and the evaluators' names.

    Errors that every candidate would meet are so found before the first round.

    Raises:
        ConfigError: if a candidate's configuration cannot be built, or an evaluator is missing.
        CheckpointError: if the start is missing, broken or does not fit the configuration.
    """
    start = convert(config.start, str, "start") if config.start is not None else None
    if not start:
        raise ConfigError(f"start: expected a run directory or a file in its checkpoints/, got {start}")
    final = [name for name in JUDGES if isinstance(config.evaluation.get(name), DictConfig)]
    if not {"success", "calibration"} <= {*final}:
        raise ConfigError(f"evaluation: expected success and calibration, to judge candidates by, got {final}")
    own = training_overrides(_example(config, Path(start)), final, config.seed)
    candidate = compose("train", [*LEADING, *train, *own])
    candidate.start = start
    adopt_networks(candidate, train)
    drop_leftovers(candidate, train, trust)
    trainer = make_trainer(candidate, None, trust)
    return trainer, start_from(trainer, start), final


def _example(config: DictConfig, start: Path) -> Task:
    """An arbitrary candidate with positive weights of all losses, to test the settings with."""
    ones = (1.0, 1.0, 1.0)
    plan = Candidate(
        name="any", schedule_initial=ones, schedule_final=ones, schedule_center=0.0, schedule_sharpness=1.0
    )
    return Task("any", start, plan, Result(checkpoint=START, weights=ones), start, config.updates)


@contextlib.contextmanager
def _tidy(out: Path) -> Iterator[None]:
    """Remove the directory of a loop that ends before it has written a file."""
    try:
        yield
    finally:
        if not any(out.iterdir()):
            remove_folder(out)


@contextlib.contextmanager
def _resumable(out: Path) -> Iterator[None]:
    """Let Ctrl-C and SIGTERM stop the loop and its candidates, and print the command that resumes it."""

    def stop(number, frame):
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    except KeyboardInterrupt as reason:
        again = [*(text for text in sys.argv[1:] if not text.startswith("out=")), f"out={quoted(out)}"]
        print(
            f"{str(reason) or 'stopped'}; resume with: python -m pirl_rl.tune {shlex.join(again)}",
            file=sys.stderr,
            flush=True,
        )
        raise SystemExit(INTERRUPTED) from None
    finally:
        signal.signal(signal.SIGTERM, previous)


def main() -> None:
    if helped(sys.argv[1:], __doc__):
        return
    sys.argv[1:] = arguments = [readable(text) for text in sys.argv[1:]]
    quiet_libraries()
    if "--report" in arguments:
        named = [item.partition("=")[2] for item in arguments if item.startswith("out=")]
        named += [item for item in arguments if not item.startswith(("-", "out="))]
        with reported(Path()):
            if len(named) != 1:
                raise ConfigError("--report: expected out=DIR, the directory of one loop")
        report(Path(named[0]))
        return
    with reported(Path()):
        if {"-m", "--multirun"} & {*arguments}:
            raise ConfigError("-m: a loop runs its candidates itself, expected candidates=... and parallel=... instead")
        for text in arguments:
            if text.startswith(OTHER_FOLDERS):
                raise ConfigError(
                    f"{text}: a loop composes its candidates from the choices of the package alone, expected the "
                    "settings of an experiment of your own as key=value"
                )
        check_overrides(arguments)
    register()
    try:
        tune()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
