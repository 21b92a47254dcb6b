"""Train a new run, or resume one.

    python -m pirl_rl.train +experiment=NAME [method=NAME] [start=RUN_DIR] [key=value ...]
    python -m pirl_rl.train resume=RUN_DIR [key=value ...]

The problem is checked first. The run directory, runs/<experiment>/<time>-<seed> or hydra.run.dir=DIR, has the
networks, the metrics, the figures and the verdict. `python -m pirl_rl` lists experiments, methods and other choices.

    key=value   any setting; --cfg job prints them all, and --hydra-help the flags of Hydra
    -m          trains once for each combination of values such as seed=0,1,2

Examples:
    python -m pirl_rl.train +experiment=reach1d
    python -m pirl_rl.train +experiment=own env.problem._target_=my_module.MyProblem
    python -m pirl_rl.train +experiment=reach1d +debug=default
    python -m pirl_rl.train +experiment=zermelo method=grid
    python -m pirl_rl.train +experiment=reach1d -m seed=0,1,2
    python -m pirl_rl.train +experiment=reach1d trainer.seeds=[0,1,2]
    python -m pirl_rl.train resume=runs/reach1d/2026-01-31_12-00-00-0 trainer.updates=20000
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from pirl_rl.assembly import make_problem
from pirl_rl.commands.catalogue import choices
from pirl_rl.commands.check import check_before_training
from pirl_rl.commands.composition import check_overrides, drop_leftovers, register
from pirl_rl.commands.console import named_modules, one_folder, override, quiet_libraries, read_switches, reported
from pirl_rl.commands.directory import begin, new_directory, own_directory, refuse_files, reopen, show
from pirl_rl.commands.methods import check_method
from pirl_rl.commands.population import resume_population, train_population
from pirl_rl.commands.solve import solve
from pirl_rl.commands.start import absolute_start, adopt_networks
from pirl_rl.configuration import CONF, PACKAGE, load_config
from pirl_rl.errors import INTERRUPTED, ConfigError
from pirl_rl.lock import locked
from pirl_rl.machine import keep_freed_memory
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.progress import announce, helped
from pirl_rl.run_directory import RunDirectory
from pirl_rl.trainer import Trainer

NOTHING_NAMED = """error: nothing to train was named, expected one of
  python -m pirl_rl.train +experiment=own env.problem._target_=my_module.MyProblem
  python -m pirl_rl.train +experiment=NAME, with NAME among {names}
`python -m pirl_rl` says what each experiment is."""


@hydra.main(version_base="1.3", config_path=str(CONF), config_name="train")
def train(config: DictConfig) -> float:
    """Train a new run in Hydra's run directory; returns the error that an optimising sweeper can minimise."""
    hydra_config = HydraConfig.get()
    absolute_start(config)
    folder = Path(hydra_config.runtime.output_dir)
    overrides = hydra_config.overrides.task
    foreign = dict.fromkeys(name for name in named_modules(overrides, config.trust) if name != PACKAGE.name)
    again = [f"trust=[{','.join(foreign)}]"] if foreign else []
    in_sweep = hydra_config.mode == RunMode.MULTIRUN
    if not in_sweep and not _folders(hydra_config.overrides.hydra):
        with reported(folder):
            folder = own_directory(folder)
    with reported(folder, one_of_many=in_sweep, again=again):
        summary = (train_in_sweep if in_sweep else train_new)(config, folder, overrides)
    return summary.get("value_mse", summary.get("hjb_sup_loss", float("nan")))


def train_in_sweep(config: DictConfig, folder: Path, overrides: Sequence[str]) -> dict[str, float]:
    """Train a run of a sweep that may have been started before: what is finished is not repeated, and what was begun is
    resumed. Returns the summary.

    Raises:
        PirlError: as `train_new` and `go_on` do, or if the directory has a run with other settings.
    """
    run = RunDirectory(folder)
    if not run.config.exists():
        return train_new(config, folder, overrides)
    refuse_other_settings(run, overrides, "hydra.sweep.dir")
    if run.summary.exists():
        print(f"run      {run} is finished already", flush=True)
        return run.numbers()
    return go_on(folder, [], named_modules(overrides, config.trust))


def refuse_other_settings(run: RunDirectory, overrides: Sequence[str], key: str) -> None:
    """Refuse a directory that holds a run with other settings, as in a sweep that was started before with others.

    Args:
        run: the directory, which need not exist.
        overrides: the overrides that the run should have.
        key: the setting that names the directory, for the message.

    Raises:
        ConfigError: the overrides of the run are others, or are not known.
    """
    if not run.config.exists():
        return
    recorded = OmegaConf.load(run.overrides) if run.overrides.exists() else None
    if recorded != overrides:
        raise ConfigError(
            f"{key}: expected a new directory, or that of runs with the same settings, but {run} holds a run with "
            f"{' '.join(recorded or ['unknown settings'])} in place of {' '.join(overrides)}"
        )


def train_new(
    config: DictConfig,
    folder: Path,
    overrides: Sequence[str],
    trust: Sequence[str] = (),
    problem: ReachAvoidProblem | None = None,
) -> dict[str, float]:
    """Train a new run in a new run directory; returns the summary.

    Args:
        config: the configuration.
        folder: the run directory, new or empty.
        overrides: the overrides of the user, which are recorded; the modules that they name are trusted.
        trust: further modules outside the package that the configuration may name.
        problem: replaces `env.problem`.

    Raises:
        PirlError: if the configuration cannot be built, or training diverges or is interrupted.
    """
    keep_freed_memory()
    with new_directory(folder):
        trust, problem = prepare(config, overrides, trust, problem)
        if config.trainer.get("seeds") is not None:
            return train_population(config, folder, overrides, trust, problem)
        if config.grid is not None:
            return solve(config, folder, overrides, trust, problem)
        trainer = begin(config, folder, overrides, trust, problem)
        summary = trainer.train()
        show(trainer, summary, config, trust)
        return summary


def prepare(
    config: DictConfig, overrides: Sequence[str], trust: Sequence[str] = (), problem: ReachAvoidProblem | None = None
) -> tuple[list[str], ReachAvoidProblem]:
    """Check the configuration of a new run and its problem; arguments are those of `train_new`.

    Returns:
        The modules outside the package that the configuration may name, and the problem.

    Raises:
        PirlError: with what was expected and what was got.
    """
    # Modules that the user names are trusted; those that a run directory names are not, since it may be foreign.
    read_switches(config)
    check_method(config, overrides)
    adopt_networks(config, overrides)
    modules = [*named_modules(overrides, config.trust), *trust]
    drop_leftovers(config, overrides, modules)
    problem = make_problem(config, modules) if problem is None else problem
    if config.check:
        announce("checking the problem")
        check_before_training(config, problem)
    return modules, problem


def resume(folder: Path, overrides: Sequence[str]) -> None:
    """Resume a run as the command does, with errors as messages."""
    with reported(folder, again=[text for text in overrides if text.startswith("trust=")]):
        go_on(folder, overrides)


def go_on(
    folder: Path, overrides: Sequence[str], trust: Sequence[str] = (), problem: ReachAvoidProblem | None = None
) -> dict[str, float]:
    """Resume a run; returns the summary.

    Args:
        folder: the run directory.
        overrides: overrides `key=value` that change its configuration for good. The modules that they name are trusted.
        trust: further modules outside the package that the configuration may name.
        problem: replaces `env.problem`, for a run that was trained on an object.

    Raises:
        PirlError: if the run cannot be resumed, or training diverges or is interrupted.
    """
    keep_freed_memory()
    config = load_config(folder)
    if config.trainer.get("seeds") is not None:
        RunDirectory(folder).refuse_links()
        with locked(RunDirectory(folder)):
            config.trust = []
            for text in overrides:
                if text.startswith("trust="):
                    override(config, text)
            modules = [*named_modules(overrides, config.trust), *trust]
            return resume_population(config, folder, overrides, modules, problem)
    with reopened(folder, overrides, trust, problem) as (trainer, config, modules):
        summary = trainer.train()
        show(trainer, summary, config, modules)
        return summary


@contextlib.contextmanager
def reopened(
    folder: Path, overrides: Sequence[str], trust: Sequence[str] = (), problem: ReachAvoidProblem | None = None
) -> Iterator[tuple[Trainer, DictConfig, list[str]]]:
    """Open a run to go on with it; arguments and errors are those of `go_on`.

    Yields:
        The trainer at its last checkpoint, the configuration, and the modules that it may name.
    """
    run, config = RunDirectory(folder), load_config(folder)
    run.refuse_links()
    with locked(run):
        config.trust, changes = [], []
        for text in overrides:
            if text.startswith("start="):
                raise ConfigError(f"{text}: the run has begun already; start= is for new runs, without resume=")
            before, after = override(config, text)
            if text.startswith("seed=") and before != after and run.last.exists():
                raise ConfigError(
                    f"{text}: a run goes on with the random numbers of its checkpoint, expected the seed {before}"
                )
            if before != after and not text.startswith("trust="):  # which counts for this command alone
                changes.append(f"resume: {text.partition('=')[0]} was {before}, and is {after} from now on")
        read_switches(config)
        if config.get("grid") is not None:
            raise ConfigError(f"resume: expected a run that was trained, but {folder} holds the solution of a grid")
        modules = [*named_modules(overrides, config.trust), *trust]
        trainer = reopen(config, folder, [f"resume={folder.name}", *overrides], modules, problem)
        for change in changes:
            print(change, flush=True)
        yield trainer, config, modules


def _folders(arguments: Sequence[str]) -> list[Path]:
    """The run directories that overrides name, which Hydra creates before it calls `train`."""
    named = (text.partition("=") for text in arguments)
    return [Path(path) for key, _, path in named if key in ("hydra.run.dir", "hydra.sweep.dir")]


def main() -> None:
    quiet_libraries()
    arguments = sys.argv[1:]
    if helped(arguments, __doc__):
        return
    if not arguments:
        print(NOTHING_NAMED.format(names=", ".join(path.stem for path in choices("experiment"))), file=sys.stderr)
        sys.exit(1)
    resumed = [item for item in arguments if item.startswith("resume=") and item != "resume=null"]
    try:
        if resumed:
            with reported(Path()):
                folder = one_folder(resumed, "resume", "the directory of a run to resume")
            resume(folder, [item for item in arguments if item not in resumed])
        else:
            with reported(Path()):
                check_overrides(arguments)
                for folder in _folders(arguments):
                    refuse_files(folder)
            register()
            train()
    except KeyboardInterrupt:
        print("stopped at once; only the updates up to the last checkpoint are kept", file=sys.stderr)
        sys.exit(INTERRUPTED)
