"""What each part of the default recipe gives: the suite's problems without that part, or with another one.

    python benchmarks/recipe.py [out=runs/recipe] [problems=zermelo,pendulum] [seeds=0,1] ['only=default,squares']

Each variant is a run of `python -m pirl_rl.suite` with other settings; a benchmark that was stopped goes on.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from pirl_rl.commands.suite import DEFAULTS
from pirl_rl.commands.suite import main as suite

STATES = "collector.initial_states"

VARIANTS: dict[str, list[str]] = {
    "default": [],
    "no levels": ["actor.levels=false", "critic.levels=false", "critic.log_levels=false"],
    "no control variate": ["collector.control_variate=null"],
    "no faces": [f"{STATES}.share=0"],
    "equal weights of starts": [f"{STATES}.others.floor=1"],
    "starts in the box alone": [f"{STATES}.others.others.share=0"],
    "no spread": ["actor.spread=null", "critic.spread=null"],
    "ascent of the Hamiltonian": ["pirl.actor_rule={_target_:pirl_rl.actor_rules.Hamiltonian}"],
    "no last stage": ["pirl.stages=[]"],
    "returns of 40 steps": ["pirl.n_steps=40"],
    "last actor": ["learner.actor_polyak=1"],
    "Adam": ["learner.optimizer=adam"],
    "1024 paths": ["env.num_envs=1024"],
    "half of the transitions": ["collector.updates_per_batch=100"],
    "squares": ["pirl.td_criterion=squares"],
    "returns as long as a batch": ["pirl.n_steps=50"],
    "returns of five steps": ["pirl.n_steps=5"],
    "residual 1 and boundary 10": ["pirl.final=[1,1,10]", "schedule.center=0.2", "schedule.steepness=30"],
    "residual 0.03": ["pirl.final=[1,0.03,0]", "schedule.center=0.3", "schedule.steepness=30"],
    "6000 updates": ["trainer.updates=6000"],
    "30000 updates": ["trainer.updates=30000"],
}
"""The settings of each variant, by a name without commas."""


def main() -> None:
    given = dict(text.split("=", 1) for text in sys.argv[1:])
    problems = given.get("problems", "double_integrator,pendulum,zermelo,radial_exit-8").split(",")
    seeds, out = given.get("seeds", "0,1").split(","), Path(given.get("out", "runs/recipe"))
    chosen = given["only"].split(",") if "only" in given else [*VARIANTS]
    rows = []
    for variant in chosen:
        folder = out / variant.replace(" ", "_")
        common = [f"out={folder}", f"seeds=[{','.join(seeds)}]", "evaluation.during=[]", "evaluation.final=[]"]
        suite([*common, f"problems=[{','.join(problems)}]", *VARIANTS[variant]])
        rows.append(f"| {variant} | {' | '.join(_cell(folder / name, seeds) for name in problems)} |")
    print(f"\n| MSE of V, loss of success | {' | '.join(problems)} |\n| --- |{' ---: |' * len(problems)}")
    print("\n".join(rows))


def _cell(folder: Path, seeds: list[str]) -> str:
    file = f"score-{DEFAULTS['states']}-{DEFAULTS['rollouts']}.json"
    scores = [json.loads((folder / seed / file).read_text(encoding="utf-8")) for seed in seeds]
    mse, loss = (sum(score[key] for score in scores) / len(scores) for key in ("mse", "loss"))
    return f"{mse:.1e}, {loss:.4f}"


if __name__ == "__main__":
    main()
