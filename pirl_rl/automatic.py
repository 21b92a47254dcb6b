"""Settings whose value is `auto`, replaced by numbers that follow from the problem."""

from __future__ import annotations

import math
from collections.abc import Sequence

from omegaconf import DictConfig, ListConfig, OmegaConf

from pirl_rl.building import convert, resolve
from pirl_rl.errors import ArgumentError, ConfigError
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.simulator import Simulator
from pirl_rl.structure import check_problem, has_controlled_noise, noise_channels
from pirl_rl.switching import actor_choices, choice_window, coordinates_together
from pirl_rl.time_steps import STEPS, check_time_steps, propose_time_steps

AUTO = "auto"
"""The value that leaves a choice to the package.

Keys that take it: env.dt, env.substeps, env.num_envs, collector.n_steps, n_steps of a stage, trainer.updates,
actor.choices, actor.together, actor.window, actor.log_levels, loss.hjb_time, loss.hjb_probes and the entries of
`PATHS`.
"""

UPDATES_PER_DIMENSION, FEW_STATES, UPDATES_OF_MANY = 2_300, 3, 2_900
"""The number of updates for each dimension of (tau, x): the first up to `FEW_STATES` states, and the last beyond."""

MOST_OF_FEW = 8_000
"""The largest number of updates up to `FEW_STATES` states. They take three minutes on two cores."""

BASE_COST, MOST_COST = 80, 1_700_000
"""The time of an update is about proportional to BASE_COST + n for n states, as measured at 6 and at 100 states.

The number of updates that is chosen, times this sum, is at most MOST_COST.
"""

PLAYED_PATHS, RETURN_STEPS = 2_048, 10
"""The number of paths that are played, and the steps of their returns, with up to `STEPS[0]` control steps."""

PATHS = {
    ("success", "episodes"): (10_000, 1_000),
    ("calibration", "rollouts"): (256, 16),
    ("slices", "rollouts"): (16, 1),
    ("verdict", "rollouts"): (64, 8),
}
"""Numbers of paths of evaluators, by evaluator and argument: the largest and the smallest that are chosen."""

PROGRESS_SHARE = 5
"""The evaluator `progress` plays one in this number of the episodes of `success`."""

CHEAP_PATH = 10_000
"""The number of coordinates of all integration steps of a path up to which evaluators have the largest numbers."""

MOST_COLUMNS = 16
"""The largest number of noise channels with which the trace of the HJB residual is computed exactly."""

PROBES = 4
"""The number of random vectors that estimate the trace with more channels."""


def choose_time_steps(config: DictConfig, problem: ReachAvoidProblem) -> None:
    """Replace `auto` in env.dt and env.substeps by numbers, and print the choice with its reason.

    Raises:
        ConfigError: one of the two is neither `auto` nor a number, or out of range; or env.crossing is unknown.
        ProblemError: the problem contradicts itself.
    """
    kinds = {"dt": float, "substeps": int}
    values = {name: config.env[name] for name in kinds if name in config.env}
    given = {name: convert(value, kinds[name], f"env.{name}") for name, value in values.items() if value != AUTO}
    crossing = config.env.get("crossing", Simulator.crossing)
    check_problem(problem)
    try:
        check_time_steps(problem, given.get("dt"), given.get("substeps"), crossing)
    except ArgumentError as error:
        raise ConfigError(f"env.{error}") from None
    if AUTO not in values.values():
        return
    chosen = propose_time_steps(problem, **given, crossing=crossing)
    config.env.dt, config.env.substeps = chosen.dt, chosen.substeps
    print(f"time: {chosen.reason}", flush=True)


def choose_playing(config: DictConfig, problem: ReachAvoidProblem) -> None:
    """Replace `auto` in env.num_envs, collector.n_steps and n_steps of the stages by numbers.

    With twice as many control steps half as many paths are played, so that they advance as far between two updates, and
    returns have twice as many steps. A stage has twice the steps of the run.
    """
    steps = problem.horizon / config.env.get("dt", Simulator.dt)
    # A power of two, since the number of paths has to divide collector.frames_per_batch.
    stretch = 2 ** round(math.log2(max(1.0, steps / STEPS[0])))
    if config.env.get("num_envs") == AUTO:
        config.env.num_envs = max(1, PLAYED_PATHS // stretch)
    # The collector may refer to the settings of the method, which a resumed run may change.
    for node in (config.get("pirl"), config.collector):
        if node is not None and node.get("n_steps") == AUTO:
            node.n_steps = RETURN_STEPS * stretch
    stages = config.get("stages")
    for stage in stages if isinstance(stages, ListConfig) else ():
        if isinstance(stage, DictConfig) and stage.get("n_steps") == AUTO:
            stage.n_steps = 2 * config.collector.get("n_steps", RETURN_STEPS)


def choose_updates(config: DictConfig, problem: ReachAvoidProblem) -> None:
    """Replace `auto` in trainer.updates by a number, which grows with the dimensions of V(tau, x) up to a limit."""
    if config.trainer.get("updates") == AUTO:
        n = problem.states.dim
        if n <= FEW_STATES:
            config.trainer.updates = min(UPDATES_PER_DIMENSION * (n + 1), MOST_OF_FEW)
        else:
            config.trainer.updates = min(UPDATES_OF_MANY * (n + 1), max(1, MOST_COST // (BASE_COST + n)))


def choose_actor(config: DictConfig, problem: ReachAvoidProblem, trust: Sequence[str] = ()) -> None:
    """Replace `auto` in choices, together, window and log_levels of the actor by values that follow from the problem.

    `pirl_rl.switching.actor_choices` says where an actor chooses, and among how many levels. It does not where a rule
    of the run, or of one of its stages, needs the gradient of the policy, or looks ahead: a control that is held for
    long cannot make up for a coarse level by switching to the next.

    Logarithms of the levels of the sets are inputs where sigma depends on the control. The noise that is best then
    changes within the layers at faces, whose widths are those of the noise.

    Args:
        config: the configuration of a run.
        problem: the physics.
        trust: modules outside the package that may hold an actor rule.
    """
    if not isinstance(config.actor, DictConfig):
        return
    if config.actor.get("choices") == AUTO:
        config.actor.choices = actor_choices(problem) if _all_suit_choices(config, trust) else None
    if config.actor.get("together") == AUTO:
        choices = config.actor.get("choices")
        config.actor.together = coordinates_together(problem, choices) if isinstance(choices, int) else 1
    if config.actor.get("window") == AUTO:
        choices, alone = config.actor.get("choices"), config.actor.get("together") == 1
        config.actor.window = choice_window(problem, choices) if isinstance(choices, int) and alone else 0.0
    if config.actor.get("log_levels") == AUTO:
        config.actor.log_levels = bool(config.actor.get("levels")) and has_controlled_noise(problem)


def _all_suit_choices(config: DictConfig, trust: Sequence[str]) -> bool:
    """Whether all actor rules of the run and its stages can train an actor that chooses, and do not look ahead."""
    stages = config.get("stages")
    of_stages = [f"stages[{i}].actor_rule" for i in range(len(stages) if isinstance(stages, ListConfig) else 0)]
    rules = ["loss.actor_rule", *(key for key in of_stages if OmegaConf.select(config, key) is not None)]
    return all(_suits_choices(config, key, trust) for key in rules)


def _suits_choices(config: DictConfig, key: str, trust: Sequence[str]) -> bool:
    """Whether an actor rule looks no steps ahead, and its class says that it trains choices.

    `Sum` knows that only of the rules it holds, and counts as one that does not.
    """
    target = OmegaConf.select(config, f"{key}._target_")
    if target is None or OmegaConf.select(config, f"{key}.steps"):
        return False
    return getattr(resolve(target, f"{key}._target_", trust), "trains_choices", None) is True


def choose_paths(config: DictConfig, problem: ReachAvoidProblem, simulator: Simulator) -> None:
    """Replace `auto` in the numbers of paths of the evaluators by numbers that fall where each path costs much.

    Otherwise the evaluation of a problem with a hundred states would take longer than its training.

    Args:
        config: the configuration of a run.
        problem: the physics.
        simulator: plays the paths of the evaluators.
    """
    moves = problem.horizon / simulator.dt * simulator.substeps * problem.states.dim
    for (evaluator, argument), (most, least) in PATHS.items():
        if config.evaluation.get(evaluator, {}).get(argument) == AUTO:
            config.evaluation[evaluator][argument] = max(least, min(most, round(most * CHEAP_PATH / moves)))
    if config.evaluation.get("progress", {}).get("episodes") == AUTO:
        episodes = convert(config.evaluation.success.episodes, int, "evaluation.success.episodes")
        config.evaluation.progress.episodes = max(1, episodes // PROGRESS_SHARE)


def choose_residual_time(config: DictConfig, problem: ReachAvoidProblem) -> None:
    """Replace `auto` in loss.hjb_time by the horizon, so that the unit of time does not matter."""
    if isinstance(config.loss, DictConfig) and config.loss.get("hjb_time") == AUTO:
        config.loss.hjb_time = float(problem.horizon)


def choose_probes(config: DictConfig, problem: ReachAvoidProblem) -> str:
    """Replace `auto` in loss.hjb_probes by a number, and give the reason where the trace is estimated, else ""."""
    # What is no node of settings is refused where the loss is built.
    if not isinstance(config.loss, DictConfig) or config.loss.get("hjb_probes") != AUTO:
        return ""
    channels = noise_channels(problem)
    config.loss.hjb_probes = PROBES if channels > MOST_COLUMNS else 0
    if not config.loss.hjb_probes:
        return ""
    instead = f"{PROBES} random vectors in place of {channels} noise channels"
    return f"The HJB residual takes {instead}; loss.hjb_probes=0 is exact."
