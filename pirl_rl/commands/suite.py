"""The suite: `python -m pirl_rl.suite [problems=[reach1d,zermelo]] [seeds=[0,1,2]] [out=runs/suite] [key=value ...]`.

Trains each problem with each seed, measures the runs against the truth, and prints one table. What is done already in
the folder `out` is not repeated, so that a suite that was stopped goes on. Settings `key=value` go to all trainings.

    problems  names of problems; all by default
    seeds     seeds of the trainings, [0] by default
    states    the number of states at which a run is measured, 400 by default
    rollouts  the number of paths from each of them, 400 by default
    out       the folder, runs/suite by default
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from pirl_rl.assembly import make_problem
from pirl_rl.commands.composition import compose
from pirl_rl.commands.console import quiet_libraries, reported
from pirl_rl.commands.train import resume, train_new
from pirl_rl.configuration import load_config
from pirl_rl.errors import ConfigError
from pirl_rl.figures import draw_suite, save_figures
from pirl_rl.files import replacing
from pirl_rl.run_directory import RunDirectory
from pirl_rl.runs.load import load_run
from pirl_rl.scoring import PROBLEMS, Score, Truth, find_truth, markdown, measure

DEFAULTS: dict[str, Any] = {"problems": [*PROBLEMS], "seeds": [0], "states": 400, "rollouts": 400, "out": "runs/suite"}

STATES_SEED = 20_000
"""The seed of the states at which runs are measured; no training uses it."""


def main(arguments: Sequence[str] | None = None) -> None:
    arguments = sys.argv[1:] if arguments is None else arguments
    if {"-h", "--help"} & {*arguments}:
        print(__doc__)
        return
    quiet_libraries()
    with reported(Path()):
        options, overrides = _options(arguments)
        folder, scores, sources = Path(options["out"]), {}, {}
        for name in options["problems"]:
            truth = _truth(folder / name, name, overrides, options["states"])
            sources[name] = truth.source
            scores[name] = [
                _score(folder / name / str(seed), name, [*overrides, f"seed={seed}"], truth, options["rollouts"])
                for seed in options["seeds"]
            ]
            with replacing(folder / "suite.md") as file:
                file.write(markdown(scores, sources) + "\n")
        figure = draw_suite({name: [asdict(run) for run in runs] for name, runs in scores.items()})
        paths = save_figures({"suite": figure}, folder)
        print(markdown(scores, sources))
        print(f"written  {folder / 'suite.md'}")
        for path in paths:
            print(f"figure   {path}")


def _options(arguments: Sequence[str]) -> tuple[dict[str, Any], list[str]]:
    """The options of this command, and the overrides of the trainings.

    Raises:
        ConfigError: an option has a wrong type, or a problem is unknown.
    """
    own = [text for text in arguments if text.partition("=")[0] in DEFAULTS]
    try:
        given: Any = OmegaConf.to_container(OmegaConf.from_dotlist(own))
    except (OmegaConfBaseException, ValueError) as error:
        raise ConfigError(f"suite: {error}") from None
    options = DEFAULTS | given
    for name in ("problems", "seeds"):
        if not isinstance(options[name], list) or not options[name]:
            raise ConfigError(f"{name}: expected a list such as {name}={DEFAULTS[name][:2]}, got {options[name]!r}")
    if unknown := [name for name in options["problems"] if name not in PROBLEMS]:
        raise ConfigError(f"problems: expected names out of {', '.join(PROBLEMS)}, got {unknown[0]!r}")
    for name, entries in (
        ("seeds", options["seeds"]),
        ("states", [options["states"]]),
        ("rollouts", [options["rollouts"]]),
    ):
        if not all(isinstance(entry, int) and entry >= (name != "seeds") for entry in entries):
            raise ConfigError(f"{name}: expected integers >= {int(name != 'seeds')}, got {options[name]!r}")
    return options, [text for text in arguments if text not in own]


def _truth(folder: Path, name: str, overrides: Sequence[str], states: int) -> Truth:
    """The truth of a problem, from its file in the folder if it is there."""
    path = folder / f"truth-{states}.pt"
    if path.is_file():
        return Truth(**torch.load(path, weights_only=True))
    problem = make_problem(compose("train", [*PROBLEMS[name], *overrides]))
    print(f"{name}: the truth at {states} states", flush=True)
    truth = find_truth(problem, states, STATES_SEED)
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(path, binary=True) as file:
        torch.save(asdict(truth), file)
    return truth


def _score(folder: Path, name: str, overrides: Sequence[str], truth: Truth, rollouts: int) -> Score:
    """The score of a run in the folder, which is trained and measured first, as far as that is not done."""
    path, run = folder / "score.json", RunDirectory(folder)
    if path.is_file():
        return Score(**json.loads(path.read_text(encoding="utf-8")))
    typed = [*PROBLEMS[name], *overrides]
    if not run.summary.is_file():
        print(f"{name}: {' '.join(overrides)}", flush=True)
        if run.last.is_file():
            resume(folder, [])
        else:
            train_new(compose("train", typed), folder, typed)
    summary = json.loads(run.summary.read_text(encoding="utf-8"))
    trained = load_run(folder, trust=load_config(folder).trust)
    score = measure(
        trained.solution, trained.simulator, truth, rollouts, summary["wall_seconds"], int(summary["updates"])
    )
    with replacing(path) as file:
        file.write(json.dumps(asdict(score), indent=2) + "\n")
    return score
