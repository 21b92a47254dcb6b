"""All advisors: sound results, plans in files, and the configuration of advisors."""

from __future__ import annotations

import json
import sys

import pytest
from omegaconf import OmegaConf
from rounds import after, history, improves, plan, request

from pirl_rl.building import build, parameters_of
from pirl_rl.configuration import CONF
from pirl_rl.errors import AdvisorError, ConfigError, PlanError
from pirl_rl.outer_loop.advisors.file import File
from pirl_rl.outer_loop.advisors.greedy import Greedy
from pirl_rl.outer_loop.parsing import MAX_ANSWER, parse_plan
from pirl_rl.outer_loop.plan import Plan


def test_only_what_was_measured_and_can_be_started_from_is_sound():
    record = after(history(), json.dumps(plan("a", "b", "c")), 3, improves)
    a, b, c = record.results
    bare = [a.model_copy(update={"checkpoint": None}), b.model_copy(update={"metrics": {"reward": 0.9}}), c]
    record = record.model_copy(update={"rounds": [record.rounds[0].model_copy(update={"results": bare})]})
    assert [record.keeps(result) for result in bare] == [False, False, True]
    assert record.best is bare[2]


# Files.


def test_one_plan_is_the_first_round_s(tmp_path):
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(plan("a")))
    record = after(history(), File(str(path)).propose(request(history())), 1, improves)
    with pytest.raises(AdvisorError, match=r"mine.json: no plan for round 2, it has 1"):
        File(str(path)).propose(request(record))


def test_a_list_goes_round_by_round_and_may_grow(tmp_path):
    path, record = tmp_path / "mine.json", history()
    path.write_text("[]")
    advisor = File(str(path))
    plans = [plan("a", hjb=0.2), plan("a", hjb=0.3)]
    for number, one in enumerate(plans, 1):
        with pytest.raises(AdvisorError, match=f"no plan for round {number}"):
            advisor.propose(request(record))
        path.write_text(json.dumps(plans[:number]))
        record = after(record, advisor.propose(request(record)), 1, improves)
        assert record.results[-1].candidate == Plan.model_validate(one).candidates[0]


def test_a_loop_is_replayed(tmp_path):
    record, replayed = history(), history()
    for number in (1, 2):
        answer = Greedy().propose(request(record, candidates=2))
        (tmp_path / "rounds" / f"{number:03d}").mkdir(parents=True)
        (tmp_path / "rounds" / f"{number:03d}" / "plan.json").write_text(answer)
        record = after(record, answer, 2, improves)
    for _ in range(2):
        replayed = after(replayed, File(str(tmp_path)).propose(request(replayed, candidates=2)), 2, improves)
    assert replayed == record
    with pytest.raises(AdvisorError, match=r"plan.json: cannot be read"):
        File(str(tmp_path)).propose(request(record))


@pytest.mark.parametrize("text", ["", "[" * 100_000, "1" * 5_000, "[1]"])
def test_files_that_hold_no_plan(text, tmp_path):
    path = tmp_path / "mine.json"
    path.write_text(text)
    with pytest.raises(PlanError):
        parse_plan(File(str(path)).propose(request(history())), history(), 1)


def test_files_that_are_none(tmp_path):
    with pytest.raises(ValueError, match="path: expected a file"):
        File(str(tmp_path / "none.json"))
    (tmp_path / "huge.json").write_text(" " * (11 * MAX_ANSWER))
    with pytest.raises(AdvisorError, match="at most"):
        File(str(tmp_path / "huge.json")).propose(request(history()))


# Configuration.

GIVEN = {
    "greedy": {},
    "optuna": {},
    "command": {"command": "ls {prompt} {plan}"},
    "openai": {"base_url": "http://localhost:1/v1", "model": "m"},
    "file": {"path": "."},
}


def test_every_advisor_is_built_from_its_configuration(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", "k")
    assert sorted(path.stem for path in (CONF / "advisor").glob("*")) == sorted([*GIVEN, "own"])
    for name, values in GIVEN.items():
        path = CONF / "advisor" / f"{name}.yaml"
        assert path.read_text().startswith("# ")
        node = OmegaConf.load(path)
        advisor = build(OmegaConf.merge(node, values), "advisor")
        # Written out, so that nothing of an extra is imported before it is chosen, and equal to the constructor's.
        for key, parameter in parameters_of(type(advisor)).items():
            if parameter.default is not parameter.empty:
                default = parameter.default
                assert node[key] == (list(default) if isinstance(default, tuple) else default)
        assert callable(advisor.propose)
        for key in values:
            given = {other: value for other, value in values.items() if other != key}
            with pytest.raises(ConfigError, match=rf"advisor\.{key}: a value is missing"):
                build(OmegaConf.merge(OmegaConf.load(path), given), "advisor")


@pytest.mark.parametrize(("name", "library"), [("optuna", "optuna"), ("openai", "httpx")])
def test_a_missing_library_is_told_with_its_extra(name, library, monkeypatch):
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.delitem(sys.modules, f"pirl_rl.outer_loop.advisors.{name}", raising=False)
    with pytest.raises(ConfigError, match=r"pip install 'pirl_rl\[tune\]'"):
        build(OmegaConf.merge(OmegaConf.load(CONF / "advisor" / f"{name}.yaml"), GIVEN[name]), "advisor")


def test_a_missing_key_is_told_at_the_start(monkeypatch):
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    node = OmegaConf.merge(OmegaConf.load(CONF / "advisor" / "openai.yaml"), GIVEN["openai"])
    with pytest.raises(
        ConfigError, match=r"advisor\.key_variable: expected the key in the environment, but OPENAI_API_KEY"
    ):
        build(node, "advisor")
