"""Evaluate a run again.

    python -m pirl_rl.evaluate run=RUN_DIR [key=value ...]

Calls the final evaluators of the run, writes their metrics and the verdict to evaluation.json in the run directory,
with the settings of the problem, the simulator and the evaluators, and draws its figures and its report.

    run           the directory of a finished run
    verbose=true  prints all metrics with their meaning
    figures=false leaves out the figures, and report=false the report
    key=value     any setting of the run but those of its networks; evaluation.final lists the evaluators
    trust         modules of your own that the run may import, such as trust=[my_module]

Examples:
    python -m pirl_rl.evaluate run=runs/reach1d/2026-01-31_12-00-00-0 verbose=true
    python -m pirl_rl.evaluate run=models/drift evaluation.success.episodes=100000
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from omegaconf import OmegaConf, open_dict

from pirl_rl.assembly import make_evaluation_simulator, make_evaluators, make_problem
from pirl_rl.commands.console import (
    TRAINED,
    named_modules,
    one_folder,
    outcome,
    override,
    program,
    read_switches,
    reported,
)
from pirl_rl.commands.report import draw_again
from pirl_rl.configuration import load_config
from pirl_rl.errors import ConfigError
from pirl_rl.evaluation import evaluate, lines_of, meanings_of, metrics_of, statements_of
from pirl_rl.figures import draw_run
from pirl_rl.files import replacing
from pirl_rl.progress import announce
from pirl_rl.run_directory import RunDirectory
from pirl_rl.runs.load import load_run


@program
def main(arguments: Sequence[str]) -> None:
    with reported(Path()):
        folder = one_folder(arguments, "run", "the directory of a finished run")
    with reported(folder):
        run, overrides = RunDirectory(folder), [text for text in arguments if not text.startswith("run=")]
        config = load_config(folder)
        config.trust = []
        with open_dict(config):
            for name, value in (("verbose", False), ("report", True)):  # older runs have no such settings
                config.setdefault(name, value)
            config.figures = True  # whatever the training drew
        for text in overrides:
            if text.partition(".")[0] in TRAINED:
                raise ConfigError(f"{text}: expected a setting of another group, since the networks are trained")
            override(config, text)
        read_switches(config)
        trust = named_modules(overrides, config.trust)
        evaluators = make_evaluators(config.evaluation, "final", trust)
        problem = make_problem(config, trust) if any(text.startswith("env.problem") for text in overrides) else None
        solution = load_run(folder, trust, device=config.device, problem=problem).solution
        run.refuse_links()
        run.require_writable()
        announce(f"measuring: {', '.join(evaluators)}")
        evidence = evaluate(solution, make_evaluation_simulator(config, solution.problem), evaluators)
        metrics = metrics_of(evidence)
        nodes = {"problem": config.env.problem} | {name: config.evaluation[name] for name in ("simulator", *evaluators)}
        settings = {"settings": {name: OmegaConf.to_container(node, resolve=True) for name, node in nodes.items()}}
        with replacing(run.evaluation) as file:
            file.write(json.dumps(statements_of(evidence) | metrics | settings, indent=2) + "\n")
        figures = draw_run(solution, run.metrics, run.figures, evidence) if config.figures else []
    meanings = meanings_of(evaluators, solution.problem)
    print(outcome(lines_of(evidence), metrics, meanings, config.verbose))
    for figure in figures:
        print(f"figure   {figure}")
    print(f"written  {run.evaluation}")
    if config.report:
        draw_again(folder, trust)
