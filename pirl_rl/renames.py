"""Conversion of configurations of format 1 to the current format.

In format 1 the actor rule is a word with its arguments in the loss, every evaluator has its own simulator, and the
schedule of a stage counts in units that stretch with the length of the run. The functions take and return nested dicts
with all references resolved.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

NestedDict = dict[str, Any]

RULES = "pirl_rl.actor_rules"
STATES = "pirl_rl.sampling.initial_states"
COLLOCATION = "pirl_rl.sampling.collocation"
DRIFT = "pirl_rl.problems.drift"

MOVED = {
    **{f"pirl_rl.initial_states.{name}": f"{STATES}.{name}" for name in ("UniformStates", "VisitedStates")},
    "pirl_rl.initial_states.EquilibriumStates": f"{DRIFT}.starts.EquilibriumStates",
    **{f"pirl_rl.collocation.{name}": f"{COLLOCATION}.{name}" for name in ("Collocation", "ReplayCollocation")},
    "pirl_rl.collocation.BoundarySampler": "pirl_rl.sampling.boundary.BoundarySampler",
    "pirl_rl.evaluation.DriftStates": f"{DRIFT}.reference_states.DriftStates",
}
"""The current `_target_` of each `_target_` of format 1 that has moved."""

SIMULATOR = ("dt", "substeps", "crossing")
"""Arguments of a simulator, which in format 1 the environment and each evaluator have."""

RULE_DEFAULTS = {"actor_rule": "both", "model_steps": 1, "ppo_clip": 0.2}
"""Defaults of the arguments of the loss of format 1 that define the actor rule."""

RULE_NAMES = {
    "q": "Q",
    "hamiltonian": "Hamiltonian",
    "both": "Sum",
    "model": "LookAhead",
    "ppo": "ClippedSurrogate",
}
"""The class of each actor rule that format 1 names by a word."""

LOSS_DROPPED = ("model_steps", "simulator", "exploration_noise", "ppo_clip")
"""Arguments of the loss of format 1 that are arguments of the actor rule in the current format."""

UPDATE_COUNTS, PER_UPDATE = ("center", "start", "end"), ("steepness",)
"""Arguments of a schedule that are numbers of updates, and those that are numbers per update."""


def upgraded(config: Mapping[str, Any]) -> NestedDict:
    """Convert a configuration of format 1 to the current format.

    Args:
        config: nested dicts and lists with all references resolved; it is not changed.

    Returns:
        A new dict. The block `pirl`, which holds values for references only, is left out.
    """
    new: NestedDict = {name: _moved(value) for name, value in config.items() if name != "pirl"}
    loss, collector = _dict(new.get("loss")), _dict(new.get("collector"))
    rule = {name: loss.get(name, default) for name, default in RULE_DEFAULTS.items()}
    rule["exploration_noise"] = collector.get("exploration_noise", 0.0)
    if loss:
        new["loss"] = {name: value for name, value in loss.items() if name not in LOSS_DROPPED}
        new["loss"]["actor_rule"] = _actor_rule(rule)
    if stages := new.get("stages"):
        stretch = new["trainer"]["updates"] / sum(stage["updates"] for stage in stages)
        new["stages"] = [_stage(stage, rule, stretch) for stage in stages]
    if evaluation := _dict(new.get("evaluation")):
        new["evaluation"] = _evaluation(evaluation, _dict(new.get("env")))
    return new


def _dict(value: Any) -> NestedDict:
    """A value if it is a dict, else an empty dict: another value in its place is refused when it is built."""
    return value if isinstance(value, dict) else {}


def _moved(value: Any) -> Any:
    """A copy with the current name of every `_target_`."""
    if isinstance(value, Mapping):
        copy = {name: _moved(entry) for name, entry in value.items()}
        if "_target_" in copy:
            copy["_target_"] = MOVED.get(copy["_target_"], copy["_target_"])
        return copy
    return [_moved(entry) for entry in value] if isinstance(value, list) else value


def _actor_rule(rule: Mapping[str, Any]) -> NestedDict | Any:
    """The node of a rule that format 1 names by a word; another value is kept, and refused when it is built."""
    targets = {word: {"_target_": f"{RULES}.{name}"} for word, name in RULE_NAMES.items()}
    arguments = {
        "both": {"rules": [targets["q"], targets["hamiltonian"]]},
        "model": {"steps": rule["model_steps"]},
        "ppo": {"clip": rule["ppo_clip"], "deviation": rule["exploration_noise"]},
    }
    word = rule["actor_rule"]
    return {**targets[word], **arguments.get(word, {})} if word in targets else word


def _stage(stage: NestedDict, run: Mapping[str, Any], stretch: float) -> NestedDict:
    """A stage with its length as a share, its rule as a node, and its schedule in updates of the run."""
    new = {"share" if name == "updates" else name: value for name, value in stage.items() if name != "model_steps"}
    own = {name: stage[name] for name in run if stage.get(name) is not None}
    rule = _actor_rule({**run, **own})
    if "actor_rule" in own or rule != _actor_rule(run):
        new["actor_rule"] = rule
    if isinstance(schedule := new.get("schedule"), dict):
        new["schedule"] = {name: _stretched(name, value, stretch) for name, value in schedule.items()}
    return new


def _stretched(name: str, value: Any, stretch: float) -> Any:
    if name in UPDATE_COUNTS:
        return value * stretch
    return value / stretch if name in PER_UPDATE else value


def _evaluation(evaluation: NestedDict, env: Mapping[str, Any]) -> NestedDict:
    """The evaluators without simulators, and one simulator for all of them with the settings of the environment."""
    new = {
        name: {key: entry for key, entry in value.items() if key not in SIMULATOR}
        if isinstance(value, dict) and "_target_" in value
        else value
        for name, value in evaluation.items()
    }
    steps = {name: f"${{env.{name}}}" for name in SIMULATOR if name in env}
    return {**new, "simulator": {"_target_": "pirl_rl.simulator.Simulator", **steps}}
