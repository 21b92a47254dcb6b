"""The Python interface, which `pirl_rl` exports: train, open a run, evaluate, check a problem, and Monte Carlo."""

from __future__ import annotations

import contextlib
import copy
import importlib
import inspect
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, overload

from pirl_rl import checking
from pirl_rl.assembly import make_evaluation_simulator, make_evaluators
from pirl_rl.commands.console import TRAINED, named_modules, override, quiet_libraries
from pirl_rl.commands.directory import own_directory
from pirl_rl.commands.population import member_names
from pirl_rl.commands.settings import compose_run, run_folder, typed_settings
from pirl_rl.commands.train import go_on, train_new
from pirl_rl.configuration import load_config
from pirl_rl.errors import ArgumentError, ConfigError, Interrupted
from pirl_rl.evaluation import evaluate as call_evaluators
from pirl_rl.evaluation import metrics_of
from pirl_rl.evaluation.monte_carlo import monte_carlo
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.runs.load import load_run
from pirl_rl.runs.run import Run

__all__ = ["check", "evaluate", "load_run", "monte_carlo", "train"]


@overload
def train(
    problem_or_experiment: ReachAvoidProblem | type[ReachAvoidProblem] | str,
    *,
    folder: str | PathLike[str] | None = None,
    seeds: None = None,
    resume: None = None,
    **settings: Any,
) -> Run: ...
@overload
def train(
    problem_or_experiment: ReachAvoidProblem | type[ReachAvoidProblem] | str,
    *,
    folder: str | PathLike[str] | None = None,
    seeds: Sequence[int],
    resume: None = None,
    **settings: Any,
) -> list[Run]: ...
@overload
def train(
    problem_or_experiment: ReachAvoidProblem | type[ReachAvoidProblem],
    *,
    folder: None = None,
    seeds: None = None,
    resume: str | PathLike[str],
    **settings: Any,
) -> Run | list[Run]: ...
def train(
    problem_or_experiment: ReachAvoidProblem | type[ReachAvoidProblem] | str,
    *,
    folder: str | PathLike[str] | None = None,
    seeds: Sequence[int] | None = None,
    resume: str | PathLike[str] | None = None,
    **settings: Any,
) -> Run | list[Run]:
    """Train like `python -m pirl_rl.train`, in a new run directory or in that of a run that goes on.

        run = pirl_rl.train("reach1d", updates=2_000, seed=3)
        run = pirl_rl.train(MyProblem, method="pirl", **{"schedule.center": 1e3})
        runs = pirl_rl.train("reach1d", seeds=[0, 1, 2])
        run = pirl_rl.train(problem, resume="runs/own/2026-01-31_12-00-00-0", updates=20_000)

    Args:
        problem_or_experiment: the name of an experiment, or a problem of your own, a class or an object, which is
            trained with the settings of the experiment `own`. The configuration of the run names a class that can be
            imported, with its arguments (`**{"env.problem.wind": -0.3}`). It cannot name an object or a class of a
            notebook, so that such a run is opened with `load_run(folder, problem=...)`, and resumed with
            `train(problem, resume=folder)`.
        folder: the run directory, new or empty; the default is `runs/<experiment>/<time>-<seed>`.
        seeds: trains a population with one member for each seed, see `pirl_rl.population`.
        resume: the directory of a run, or of a population, that was trained on this problem and goes on from its last
            checkpoint. `settings` change it for good.
        **settings: an argument of the trainer (`updates=200`), a key of the configuration (`seed=3`, `compile=False`),
            a choice of a group (`method="td3"`, `logger="none"`), a nested mapping (`schedule={"center": 1e3}`) or a
            key with dots (`**{"schedule.center": 1e3}`). As on the command line, a plus sign in front adds an argument
            that the configuration leaves at its default (`**{"+pirl.actor_rule.hold": 0.0}`).

    Returns:
        The run, opened from its directory, or the runs of all members of a population.

    Raises:
        ConfigError: for an unknown setting, or a value that cannot be built; the message lists the known settings.
        ProblemError: if the problem contradicts itself.
        DivergenceError: if a loss is not finite or explodes.
        Interrupted: if training was asked to stop; it can be resumed from the run directory.
    """
    experiment, problem, named, trust = _subject(problem_or_experiment)
    if problem is not None:
        _refuse_arguments(problem, settings)
    if seeds is not None:
        if not isinstance(seeds, Iterable):
            raise ArgumentError(f"seeds: expected a list of integers, as for seeds=[0, 1, 2], got {seeds!r}")
        settings["trainer.seeds"] = list(seeds)
    with warnings.catch_warnings():
        quiet_libraries()
        if resume is not None:
            if isinstance(problem_or_experiment, str) or folder is not None or seeds is not None:
                raise ConfigError(
                    "resume: expected a problem, and no folder and no seeds, which are those of the run; "
                    "python -m pirl_rl.train resume=RUN_DIR resumes a run of an experiment"
                )
            path = Path(resume).absolute()
            config = load_config(path)
            config.trust = settings.get("trust", [])  # a run directory may be foreign and is not asked
            typed = typed_settings({**named, **settings}, config, "trainer")
            with _named_when_stopped(path):
                go_on(path, typed, trust, problem)
        else:
            config, typed = compose_run(experiment, {**named, **settings})
            default = run_folder(config)
            path = own_directory(Path(default).absolute()) if folder is None else Path(folder).absolute()
            with _named_when_stopped(path):
                train_new(config, path, typed, trust, problem)
    modules = [*named_modules(typed, config.trust), *trust]
    if config.trainer.get("seeds") is not None:
        return [load_run(path / name, modules, problem=problem) for name in member_names(config)]
    return load_run(path, modules, problem=problem)


@contextlib.contextmanager
def _named_when_stopped(folder: Path) -> Iterator[None]:
    """Let the message of a training that is stopped name its directory."""
    try:
        yield
    except Interrupted as stop:
        raise Interrupted(stop.update, folder) from None


def _subject(subject: Any) -> tuple[str, ReachAvoidProblem | None, dict[str, str], list[str]]:
    """The experiment, the problem if no configuration can name it, the settings that name it else, and their modules.

    Raises:
        ArgumentError: if the argument of `train` is neither a name nor a problem.
    """
    if isinstance(subject, str):
        return subject, None, {}, []
    if inspect.isclass(subject) and issubclass(subject, ReachAvoidProblem):
        _refuse_abstract(subject, "problem_or_experiment")
        if not _importable(subject):
            return "own", _made(subject, "problem_or_experiment"), {}, []
        return "own", None, {"env.problem._target_": f"{subject.__module__}.{subject.__name__}"}, [subject.__module__]
    if isinstance(subject, ReachAvoidProblem):
        return "own", subject, {}, []
    raise ArgumentError(
        "problem_or_experiment: expected the name of an experiment, a ReachAvoidProblem or a subclass of it, got "
        f"{type(subject).__name__}"
    )


def _refuse_abstract(kind: type[ReachAvoidProblem], argument: str) -> None:
    """Refuse a class of problems without a method that each needs.

    Raises:
        ArgumentError: the class lacks a method.
    """
    if missing := ", ".join(sorted(kind.__abstractmethods__)):
        raise ArgumentError(f"{argument}: {kind.__qualname__} lacks {missing}")


def _made(kind: type[ReachAvoidProblem], argument: str) -> ReachAvoidProblem:
    """An object of a class of problems, which must need no arguments.

    Raises:
        ArgumentError: the class needs some.
    """
    try:
        inspect.signature(kind).bind()
    except TypeError as error:
        raise ArgumentError(
            f"{argument}: {kind.__qualname__} needs arguments ({error}), expected an object, {kind.__qualname__}(...)"
        ) from None
    return kind()


def _refuse_arguments(problem: ReachAvoidProblem, settings: Mapping[str, Any]) -> None:
    """Refuse arguments of a problem that is an object already.

    Raises:
        ConfigError: if the settings have a key of `env.problem`.
    """
    nested = settings.get("env")
    within = nested if isinstance(nested, Mapping) else {}
    keys = [*settings, *(f"env.{name}" for name in within)]
    for key in (key for key in keys if key == "env.problem" or key.startswith("env.problem.")):
        raise ConfigError(
            f"{key}: expected no arguments of the problem, which is an object of {type(problem).__name__} that no "
            f"configuration names; give them to {type(problem).__name__}(...) and train what it returns"
        )


def _importable(subject: type) -> bool:
    """Whether another process can import the class by its name; in another process `__main__` is another module."""
    if subject.__module__ == "__main__":
        return False
    try:
        return getattr(importlib.import_module(subject.__module__), subject.__name__, None) is subject
    except ImportError:
        return False


def check(
    problem: ReachAvoidProblem | type[ReachAvoidProblem], dt: float | None = None, substeps: int | None = None
) -> list[checking.Finding]:
    """The warnings and notes about a problem, an object or a class; see `pirl_rl.checking.examine` for the arguments.

    Raises:
        ProblemError: the problem has errors; the message lists them.
        ArgumentError: `problem` is no problem, or a time step is out of range.
    """
    if inspect.isclass(problem) and issubclass(problem, ReachAvoidProblem):
        _refuse_abstract(problem, "problem")
        problem = _made(problem, "problem")
    return checking.check(problem, dt, substeps)


def evaluate(run: Run | str | PathLike[str], *, trust: Sequence[str] | str = (), **settings: Any) -> dict[str, float]:
    """Call the final evaluators of a run, with changed settings if wanted. Nothing is written.

        pirl_rl.evaluate(run, final=["success"], success={"episodes": 100_000})

    Args:
        run: a run, or its directory.
        trust: modules outside pirl_rl that its configuration may name, a list or one name.
        **settings: entries of `evaluation`, or any key of the run's configuration, as in `train`.

    Returns:
        The metrics by name.

    Raises:
        ConfigError: for an unknown setting, or a value that cannot be built; the message lists the known settings.
    """
    if not isinstance(run, Run):
        run = load_run(run, trust)
    config = copy.deepcopy(run.config)
    typed = typed_settings(settings, config, "evaluation")
    for text in typed:
        if text.partition(".")[0] in TRAINED or text.startswith("env.problem"):
            raise ConfigError(
                f"{text}: expected a setting of evaluation or of env, since problem and networks are those of the run; "
                "load_run(folder, problem=...) opens it with another problem"
            )
        override(config, text)
    evaluators = make_evaluators(config.evaluation, "final", [*run.trust, *named_modules(typed, trust)])
    simulator = make_evaluation_simulator(config, run.problem)
    return metrics_of(call_evaluators(run.solution, simulator, evaluators))
