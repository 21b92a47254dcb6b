"""Train the suite of problems and compare it with known answers.

    python -m pirl_rl.suite [problems=[NAME,...]] [seeds=[0,1,2]] [against=[grid,lqr,ppo,sac]] [out=DIR] [key=value ...]

Trains each problem with each seed, measures the runs against the truth, and prints one table. What is done already in
the folder `out` is not repeated, so that a suite that was stopped goes on. The table and the figure have all runs of
the folder that were measured at the same states with as many rollouts, so that several commands can fill one folder.

    problems   names of problems; all by default
    seeds      seeds of the trainings, [0] by default
    states     the number of states at which a run is measured, 400 by default
    draw       the number of the draw of these states, 0 by default; a choice that was made at the states of one draw is
               reported at those of another
    rollouts   the number of paths from each of them, 1,000 by default
    against    alternatives that are measured at the same states, out of grid, lqr, ppo and sac; none by default.
               The grid is timed until its error is that of the worst run. The others give a policy; ppo and sac are
               those of Stable-Baselines3, from the extra `baselines`
    patience   how many times as long as the recipe ppo and sac train, 10 by default
    out        the folder, runs/suite by default
    key=value  any other setting goes to all trainings

Examples:
    python -m pirl_rl.suite problems=[reach1d,zermelo] seeds=[0,1,2]
    python -m pirl_rl.suite problems=[quadrotor] against=[lqr,ppo,sac]
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from pirl_rl.assembly import make_problem
from pirl_rl.commands.composition import compose
from pirl_rl.commands.console import named_modules, program, read_settings, reported
from pirl_rl.commands.train import go_on, refuse_other_settings, train_new
from pirl_rl.errors import ConfigError
from pirl_rl.figures import draw_suite, save_figures
from pirl_rl.files import replacing
from pirl_rl.rivals import RIVALS
from pirl_rl.run_directory import RunDirectory
from pirl_rl.runs.load import load_run
from pirl_rl.scoring import (
    PROBLEMS,
    Alternative,
    Score,
    Truth,
    find_truth,
    markdown,
    measure,
    play_rival,
    race_grid,
)

DEFAULTS: dict[str, Any] = {
    "problems": [*PROBLEMS],
    "seeds": [0],
    "states": 400,
    "draw": 0,
    "rollouts": 1_000,
    "against": [],
    "patience": 10.0,
    "out": "runs/suite",
}

ALTERNATIVES = ("grid", *RIVALS)

STATES_SEED = 30_000
"""The seed of the first draw of the states at which runs are measured. Trainings never use it."""


@program
def main(arguments: Sequence[str]) -> None:
    with reported(Path()):
        options, overrides = _options(arguments)
        folder, others = Path(options["out"]), {}
        for name in options["problems"]:
            truth = _truth(folder / name, name, overrides, options)
            typed = [*PROBLEMS[name], *overrides]
            trust = named_modules(typed, compose("train", typed).trust)
            own = [
                _score(folder / name / str(seed), name, [*overrides, f"seed={seed}"], truth, options, trust)
                for seed in options["seeds"]
            ]
            others[name] = {
                other: _alternative(folder / name, other, own, truth, options, trust) for other in options["against"]
            }
            scores, sources = _measured(folder, options)
            table = markdown(scores, sources, others)
            with replacing(folder / "suite.md") as file:
                file.write(table + "\n")
        figure = draw_suite({name: [asdict(run) for run in runs] for name, runs in scores.items()})
        paths = save_figures({"suite": figure}, folder)
        print(table)
        print(f"written  {folder / 'suite.md'}")
        for path in paths:
            print(f"figure   {path}")


def _options(arguments: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """The options of this command, and the overrides of the trainings.

    Raises:
        ConfigError: an option has a wrong type, or a problem is unknown.
    """
    own = [text for text in arguments if text.partition("=")[0] in DEFAULTS]
    options = DEFAULTS | read_settings(own)
    for name in ("problems", "seeds", "against"):
        if not isinstance(options[name], list) or not (options[name] or name == "against"):
            raise ConfigError(f"{name}: expected a list such as {name}={DEFAULTS[name][:2]}, got {options[name]!r}")
    for name, known in (("problems", PROBLEMS), ("against", ALTERNATIVES)):
        if unknown := [entry for entry in options[name] if entry not in known]:
            raise ConfigError(f"{name}: expected names out of {', '.join(known)}, got {unknown[0]!r}")
    if not isinstance(options["patience"], (int, float)) or not options["patience"] > 0:
        raise ConfigError(f"patience: expected a number > 0, got {options['patience']!r}")
    for name, least in (("seeds", 0), ("draw", 0), ("states", 1), ("rollouts", 1)):
        entries = options[name] if name == "seeds" else [options[name]]
        if not all(isinstance(entry, int) and entry >= least for entry in entries):
            raise ConfigError(f"{name}: expected integers >= {least}, got {options[name]!r}")
    return options, [text for text in arguments if text not in own]


def _truth(folder: Path, name: str, overrides: Sequence[str], options: dict[str, Any]) -> Truth:
    """The truth of a problem, from its file in the folder if it is there."""
    path, states = _truth_file(folder, options), options["states"]
    changes = sorted(text for text in overrides if text.lstrip("+").startswith("env.problem"))
    if path.is_file():
        truth, known = _read_truth(path)
        if known != changes:
            raise ConfigError(
                f"out: {path} is the truth of the problem with {' '.join(known) or 'no settings'}, expected one with "
                f"{' '.join(changes) or 'no settings'}; give another folder, with out=DIR"
            )
        return truth
    problem = make_problem(compose("train", [*PROBLEMS[name], *overrides]))
    print(f"{name}: the truth at {states} states", flush=True)
    truth = find_truth(problem, states, STATES_SEED + options["draw"])
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(path, binary=True) as file:
        torch.save(asdict(truth) | {"changes": changes}, file)
    return truth


def _read_truth(path: Path) -> tuple[Truth, list[str]]:
    """The truth in a file, and the settings that changed its problem."""
    entries = torch.load(path, weights_only=True)
    changes = entries.pop("changes", [])
    return Truth(**entries), changes


def _states(options: dict[str, Any]) -> str:
    """The states at which runs are measured, as a part of the names of files."""
    return f"{options['states']}-draw{options['draw']}" if options["draw"] else str(options["states"])


def _truth_file(folder: Path, options: dict[str, Any]) -> Path:
    """The file with the truth of a problem."""
    return folder / f"truth-{_states(options)}.pt"


def _measured(folder: Path, options: dict[str, Any]) -> tuple[dict[str, list[Score]], dict[str, str]]:
    """The scores of all runs in the folder, and where the truth of each problem comes from, by problem."""
    scores, sources = {}, {}
    for name in PROBLEMS:
        known = _truth_file(folder / name, options)
        if not known.is_file():
            continue
        truth, _ = _read_truth(known)
        file = _score_file(options)
        runs = [run for run in (folder / name).iterdir() if run.name.isdecimal() and (run / file).is_file()]
        seeds = sorted(int(run.name) for run in runs)
        paths = [folder / name / str(seed) / file for seed in seeds]
        if paths:
            scores[name] = [Score.load(path) for path in paths]
            sources[name] = truth.source
    return scores, sources


def _score_file(options: dict[str, Any]) -> str:
    """The name of the file with the score of a run."""
    return f"score-{_states(options)}-{options['rollouts']}.json"


def _score(
    folder: Path, name: str, overrides: Sequence[str], truth: Truth, options: dict[str, Any], trust: Sequence[str]
) -> Score:
    """The score of a run in the folder, which is trained and measured first, as far as that is not done.

    It imports modules that the settings of this command trust, whatever the run's own configuration says.
    """
    path, run = folder / _score_file(options), RunDirectory(folder)
    typed = [*PROBLEMS[name], *overrides]
    refuse_other_settings(run, typed, "out")
    if path.is_file():
        return Score.load(path)
    if not run.summary.is_file():
        print(f"{name}: {' '.join(overrides)}", flush=True)
        with reported(folder):
            if run.config.is_file():
                go_on(folder, [], trust)
            else:
                train_new(compose("train", typed), folder, typed)
    summary = json.loads(run.summary.read_text(encoding="utf-8"))
    trained = load_run(folder, trust=trust)
    seconds, updates = summary["wall_seconds"], int(summary.get("updates", 0))
    score = measure(trained.solution, trained.simulator, truth, options["rollouts"], seconds, updates)
    score.save(path)
    return score


def _alternative(
    folder: Path, other: str, scores: Sequence[Score], truth: Truth, options: dict[str, Any], trust: Sequence[str]
) -> Alternative | None:
    """An alternative at the states of the truth, from its file if it is there; None where it does not suit.

    The grid is timed anew, because its goal is the error of the worst run, which changes with the seeds.
    """
    path = folder / f"{other}-{_states(options)}-{options['rollouts']}-{options['patience']:g}.json"
    if path.is_file() and other != "grid":
        found = json.loads(path.read_text(encoding="utf-8"))
        return None if found is None else Alternative(**found)
    trained = load_run(folder / str(options["seeds"][0]), trust=trust)
    print(f"{folder.name}: {other}", flush=True)
    if other == "grid":
        alternative = race_grid(trained.problem, truth, max(score.mse for score in scores))
    else:
        seconds = options["patience"] * sum(score.seconds for score in scores) / len(scores)
        alternative = play_rival(
            other, trained.problem, trained.simulator, truth, seconds, options["rollouts"], options["seeds"][0]
        )
    with replacing(path) as file:
        file.write(json.dumps(None if alternative is None else asdict(alternative), indent=2) + "\n")
    return alternative
