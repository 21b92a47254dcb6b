"""Methods and experiments: what each pair composes, and what is refused."""

from __future__ import annotations

import pytest
from hydra.errors import HydraException
from omegaconf import OmegaConf

from pirl_rl.assembly import make_trainer
from pirl_rl.automatic import PATHS
from pirl_rl.building import build, parameters_of, resolve
from pirl_rl.commands.composition import arguments, compose, drop_leftovers
from pirl_rl.commands.methods import check_method, owned
from pirl_rl.configuration import CONF
from pirl_rl.curriculum import Curriculum, Stage
from pirl_rl.errors import ConfigError

EXPERIMENTS = sorted(path.stem for path in (CONF / "experiment").glob("*.yaml"))
WITH_SETTINGS = {"own", "reach1d", "reach1d_paper", *(name for name in EXPERIMENTS if name.startswith("drift"))}
"""The experiments with settings of their own, and `own` and `reach1d`, for all that choose nothing but a problem."""

METHODS = sorted(path.stem for path in (CONF / "method").glob("*.yaml") if path.stem != "grid")
"""The methods that learn."""

CONTINUED = ("drift_refine", "drift_value")
"""The experiments that continue a run of PIRL by stages of their own, which no other method has."""

REFUSED = {(experiment, method) for experiment in CONTINUED for method in METHODS if method != "pirl"}
"""The experiments with the methods that they are not made for."""

TERMS = {"td3": "t", "pinn": "pb", "pinn_paper": "pb", "fixed": "t", "pirl": "t", "pirl_paper": "tpb"}
"""The loss terms of a method: temporal differences, PDE, boundary."""

Q_METHODS = ("td3", "pirl_paper", "pinn_paper")


def composed(experiment: str, *overrides: str):
    typed = [f"+experiment={experiment}", *overrides]
    if experiment == "own":
        typed.append("env.problem._target_=pirl_rl.problems.Safety1D")
    config = compose("train", typed)
    check_method(config, typed)
    return config


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "experiment", [pytest.param(name, marks=[pytest.mark.slow] * (name not in WITH_SETTINGS)) for name in EXPERIMENTS]
)
def test_every_pair_is_what_the_method_says_or_refused(experiment, method):
    if (experiment, method) in REFUSED:
        with pytest.raises(ConfigError, match=f"{experiment} is made for method=pirl, got {method}"):
            composed(experiment, f"method={method}")
        return
    config = composed(experiment, f"method={method}")
    assert config.method_name == method
    assert config.experiment_name == experiment
    assert config.critic.action_input == (method in Q_METHODS)
    rules = [config.loss.actor_rule, *(stage.actor_rule for stage in config.stages if "actor_rule" in stage)]
    assert all((rule["_target_"] == "pirl_rl.actor_rules.Q") == (method in Q_METHODS) for rule in rules)
    assert (config.collector.exploration_noise > 0) == (config.loss.policy_noise > 0) == (method in Q_METHODS)
    if method in Q_METHODS:
        assert (config.critics, config.collector.n_steps, config.loss.target_critics) == (2, 1, "min")
        assert all("n_steps" not in stage and "train_actor" not in stage for stage in config.stages)
    ends = [config.schedule.initial, config.schedule.final]
    ends += [
        end for stage in config.stages if "schedule" in stage for end in (stage.schedule.initial, stage.schedule.final)
    ]
    used = {name for end in ends for name, weight in zip("tpb", end, strict=True) if weight}
    assert used == set(TERMS[method])
    if method in ("td3", "pinn", "pinn_paper", "fixed"):
        assert list(config.schedule.initial) == list(config.schedule.final)
        assert not any("schedule" in stage for stage in config.stages)


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_an_experiment_runs_the_method_that_it_names(experiment):
    """Without method=..., the method is the experiment's choice, and it owns all of its settings there too."""
    config = composed(experiment)
    raw = OmegaConf.to_container(config, resolve=False)
    for key, value in owned(config.method_name):
        found = raw
        for name in key.split("."):
            found = found[name]
        assert found == value, key


@pytest.mark.parametrize("experiment", [name for name in EXPERIMENTS if name not in CONTINUED])
def test_the_grid_is_a_method_of_every_experiment(experiment):
    config = composed(experiment, "method=grid")
    assert (config.method_name, config.grid["_target_"]) == ("grid", "pirl_rl.grid.GridSolver")
    assert composed(experiment).grid is None


def test_paper_experiments_run_the_paper_s_methods():
    assert composed("reach1d_paper").method_name == composed("drift_paper").method_name == "pirl_paper"
    assert composed("drift_td3_fixed").method_name == composed("drift_td3_random").method_name == "td3"


def test_td3_on_the_paper_s_drifting_has_td3_s_stages_alone():
    """The stages in which the physics grows belong to pirl_paper."""
    config = composed("drift_paper", "method=td3")
    assert [stage.share for stage in config.stages] == [1, 4]
    assert len(composed("drift_paper").stages) == 8


@pytest.mark.parametrize("updates", [15_000_000, 1_500])
def test_the_paper_s_drifting_adds_the_physics_after_a_third_of_the_run(updates):
    """Facts of the paper: weights (1, 0, 0) to 5e6 updates, then 0.001 at 6e6, 0.002 at 7e6 and 8e6, 0.0015 from 10e6.

    A sigmoid is off its ends by exp(-5), that is by 7e-6 for steps of 0.001.
    """
    config = composed("drift_paper", f"trainer.updates={updates}")
    stages = [
        Stage(stage.share, build(stage.schedule, "s") if "schedule" in stage else None) for stage in config.stages
    ]
    curriculum = Curriculum(build(config.schedule, "schedule"), updates, stages)
    for share, weight in ((0, 0), (4.9, 0), (5.99, 1e-3), (6.99, 2e-3), (7.99, 2e-3), (8.99, 1.5e-3), (14.9, 1.5e-3)):
        td, hjb, boundary = curriculum.weights(int(share / 15 * updates))
        assert (td, hjb) == (1, boundary)
        assert hjb == pytest.approx(weight, abs=1e-5)


def test_an_experiment_that_changes_a_method_in_silence_is_refused():
    config = compose("train", ["+experiment=reach1d", "method=td3"])
    config.collector.n_steps = 5
    with pytest.raises(ConfigError, match=r"collector.n_steps: the method td3 sets 1, and .* reach1d would .* to 5"):
        check_method(config, ["+experiment=reach1d", "method=td3"])


@pytest.mark.parametrize("typed", ["collector.n_steps=5", "loss.actor_rule._target_=pirl_rl.actor_rules.Q"])
def test_what_is_typed_is_on_purpose(typed):
    overrides = ["+experiment=reach1d", "method=td3", typed]
    check_method(compose("train", overrides), overrides)


def nodes(config, key=""):
    """All nodes with a `_target_`, with their keys."""
    if OmegaConf.is_dict(config):
        if "_target_" in config and not OmegaConf.is_missing(config, "_target_"):
            yield key, config
        for name in config:
            if not OmegaConf.is_missing(config, name):
                yield from nodes(config[name], f"{key}.{name}".lstrip("."))


@pytest.mark.parametrize("overrides", [(), ("+experiment=drift",), ("collector=multi_async", "schedule=linear")])
def test_every_constructor_argument_is_a_key(overrides):
    """So that plain key=value reaches it; `pirl` and `td3` hold what experiments set of a method."""
    config = compose("train", overrides)
    found = {key: node for key, node in nodes(config) if key.partition(".")[0] not in ("pirl", "td3", "hydra")}
    assert {"actor", "critic", "loss", "learner", "trainer", "env", "env.initial_states", "collector"} <= found.keys()
    for key, node in found.items():
        # The collector's laws of starts end with that of the environment, which stands there.
        # An experiment replaces the actor rule, whose arguments therefore stand nowhere.
        actor_rule = {"steps", "levels", "budget", "inertia", "ahead", "hold"}
        supplied = {"collector.initial_states.others.others": {"others"}, "loss.actor_rule": actor_rule}.get(key, set())
        assert {*node} | supplied >= {*arguments(node._target_)}, key


@pytest.mark.parametrize("method", ["pirl", "td3"])
def test_what_differs_from_the_constructors_stands_in_the_method_and_its_recipe(method):
    """What conf/ composes for reach1d is the default of each constructor, except what a method or a group chooses."""
    config = compose("train", ["+experiment=reach1d", f"method={method}"])
    chosen = {key for key, _ in owned(method)} | {"schedule.center", "schedule.steepness"}
    chosen |= {f"{simulator}.{name}" for simulator in ("env", "evaluation.simulator") for name in ("dt", "substeps")}
    chosen |= {"loss.hjb_probes", "evaluation.progress.episodes"}
    chosen |= {f"evaluation.{evaluator}.{argument}" for evaluator, argument in PATHS}
    if method == "pirl":
        recipe = OmegaConf.load(CONF / "recipe" / "any_problem.yaml")
        chosen |= {f"{group}.{name}" for group in recipe for name in recipe[group]}
    for key, node in nodes(config):
        parameters = parameters_of(resolve(node._target_, key))
        for name, value in node.items():
            if (key, name) == ("trainer", "seeds"):
                continue  # the command's own
            default = parameters[name].default if name in parameters else parameters
            if name == "_target_" or default is parameters[name].empty or isinstance(value, type(node)):
                continue
            plain = tuple(value) if OmegaConf.is_list(value) else value
            known = any(f"{key}.{name}".startswith(setting) for setting in chosen)
            assert plain == default or known, f"{key}.{name}"


@pytest.mark.parametrize("typed", ["trainer.update=5", "env.problem.horizn=1", "sede=3", "env.args=[]"])
def test_a_mistyped_key_is_refused(typed):
    with pytest.raises(HydraException, match=typed.partition("=")[0].rpartition(".")[2]):
        compose("train", ["+experiment=reach1d", typed])


@pytest.mark.parametrize("typed", ["env.problem.horizon=1.5", "env.initial_states.tau=fixed", "loss.logit_penalty=0.1"])
def test_arguments_that_no_yaml_file_names_are_reached(typed):
    trainer = make_trainer(compose("train", ["+experiment=reach1d", "+debug=default", typed]))
    found = {
        "env.problem.horizon": trainer.solution.problem.horizon,
        "env.initial_states.tau": trainer.collector.initial_states.others.others.others.tau,
        "loss.logit_penalty": trainer.learner.loss.logit_penalty,
    }
    key, _, value = typed.partition("=")
    assert str(found[key]) == value


def test_a_new_target_leaves_the_arguments_of_the_old_one_behind():
    """Except those that were typed beside it, and those that it has too."""
    typed = ["+experiment=drift", "pirl.actor_rule._target_=pirl_rl.actor_rules.Hamiltonian"]
    config = compose("train", typed)
    assert config.pirl.actor_rule.steps == 3
    drop_leftovers(config, typed, [])
    assert config.pirl.actor_rule == {"_target_": "pirl_rl.actor_rules.Hamiltonian"}
    typed = ["collocation._target_=pirl_rl.sampling.collocation.ReplayCollocation", "collocation.size=70"]
    config = compose("train", typed)
    before = dict(config.collocation)
    drop_leftovers(config, typed, [])
    assert dict(config.collocation) == before
