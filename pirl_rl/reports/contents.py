"""What a report says about one run, read from its directory."""

from __future__ import annotations

import json
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from omegaconf import DictConfig, OmegaConf

from pirl_rl.assembly import make_evaluation_simulator
from pirl_rl.checkpoint import digest
from pirl_rl.errors import ProofError, RunError
from pirl_rl.evaluation.planes import planes_of
from pirl_rl.loggers import read_metrics
from pirl_rl.machine import read_sessions
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.proofs import LowerBound, UpperBound
from pirl_rl.reports.curves import training_curves
from pirl_rl.reports.line import line_maps
from pirl_rl.reports.maps import plane_maps, shown_controls
from pirl_rl.reports.meanings import TITLES, meanings
from pirl_rl.reports.packing import pictures
from pirl_rl.reports.paths import sample_paths
from pirl_rl.reports.statement import Statement
from pirl_rl.run_directory import RunDirectory
from pirl_rl.runs.load import load_run
from pirl_rl.runs.run import Run

JSON = (
    RunDirectory.SUMMARY,
    RunDirectory.EVALUATION,
    RunDirectory.CERTIFICATE,
    RunDirectory.PROOF,
    RunDirectory.LIMIT,
)
"""The files whose numbers a report shows."""


@dataclass(frozen=True)
class Budget:
    """The most that one run may add to a page.

    Attributes:
        maps: bytes of V and the policy before compression.
        pictures: characters of all pictures.
    """

    maps: int
    pictures: int


@dataclass(frozen=True)
class Contents:
    """The contents of a report about one run.

    Attributes:
        name: the name of the run directory.
        config: the configuration.
        files: the JSON files that exist, by name.
        statement: the problem.
        meanings: the meanings of metrics, by group and metric.
        data: maps, paths and curves, for the scripts of the page.
        figures: the figures as addresses, with their sizes.
        left_out: names of figures that did not fit.
        networks: the SHA-256 of the policy and V.
        proved: whether what was proved about a policy is about these networks and this problem.
        limited: whether what was proved about all policies is about this problem.
        sessions: how the run was made, see `pirl_rl.machine`.
        overrides: the overrides of its command line; empty where they are not known.
    """

    name: str
    config: DictConfig
    files: dict[str, dict[str, Any]]
    statement: Statement
    meanings: dict[str, dict[str, str]]
    data: dict[str, Any]
    figures: dict[str, dict[str, Any]]
    left_out: list[str]
    networks: str
    proved: bool
    limited: bool
    sessions: list[dict[str, Any]]
    overrides: list[str]

    @classmethod
    def of(
        cls, folder: Path, budget: Budget, trust: Sequence[str] = (), problem: ReachAvoidProblem | None = None
    ) -> Contents:
        """Read a run directory, and evaluate its V and its policy.

        Raises:
            PirlError: the directory holds no run that can be opened, a link leads out of it, or a file is broken.
        """
        directory = RunDirectory(folder)
        directory.refuse_links()
        run = load_run(folder, trust, problem=problem)
        networks = digest(run.solution.arrays())
        drawn = sorted(directory.figures.glob("*.png"))
        try:
            figures = pictures(drawn, budget.pictures)
        except OSError as error:
            raise RunError(f"{directory.figures}: expected pictures, got {error}") from error
        return cls(
            name=folder.resolve().name,
            config=run.config,
            files={str(name): read_json(folder / name) for name in JSON if (folder / name).is_file()},
            statement=Statement.of(run.problem, planes_of(run.solution)),
            meanings=meanings(run.config, run.problem, trust),
            data=_data(run, directory, networks, budget),
            figures=figures,
            left_out=[path.stem for path in drawn if path.stem not in figures],
            networks=networks,
            proved=_proof(directory, run.problem, networks) is not None,
            limited=_limit(directory, run.problem) is not None,
            sessions=read_sessions(directory),
            overrides=_overrides(directory),
        )

    @property
    def title(self) -> str:
        """The problem, the method and the seed."""
        method = self.config.get("method_name", "unknown")
        return f"{self.statement.name}, {method} method, seed {self.config.get('seed')}"

    @property
    def argument(self) -> str:
        """The argument by which a command line in the folder that holds the run names it."""
        return shlex.quote(f"run={self.name}")

    @property
    def of_object(self) -> bool:
        """Whether the run was trained on an object of Python code, which its configuration does not name."""
        return OmegaConf.is_missing(self.config.env.problem, "_target_")

    @property
    def settings(self) -> str:
        """The configuration as YAML."""
        return OmegaConf.to_yaml(self.config)

    def groups(self) -> list[tuple[str, list[tuple[str, str]]]]:
        """All numbers of summary.json and evaluation.json: titles of groups, with the names and meanings of metrics."""
        names = dict.fromkeys(
            key
            for file in (RunDirectory.SUMMARY, RunDirectory.EVALUATION)
            for key, value in self.files.get(str(file), {}).items()
            if not isinstance(value, (str, dict))  # words, and the settings of the evaluators
        )
        known = {name for group in self.meanings.values() for name in group}
        groups = {**self.meanings, "run": {name: "" for name in names if name not in known}}
        found = [
            (TITLES.get(group, group), [(name, text) for name, text in texts.items() if name in names])
            for group, texts in groups.items()
        ]
        return [(title, rows) for title, rows in found if rows]


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file.

    Raises:
        RunError: the file holds no JSON object.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise RunError(f"{path}: expected a JSON object, got {error}") from error
    if not isinstance(found, dict):
        raise RunError(f"{path}: expected a JSON object, got {type(found).__name__}")
    return found


def _data(run: Run, directory: RunDirectory, networks: str, budget: Budget) -> dict[str, Any]:
    solution = run.solution
    simulator = make_evaluation_simulator(run.config, run.problem)
    found: dict[str, Any] = {
        "horizon": run.problem.horizon,
        "controls": shown_controls(solution),
        "paths": sample_paths(solution, simulator),
        "curves": training_curves(_metrics(directory)),
    }
    if run.problem.states.dim > 1:
        return found | {"planes": plane_maps(solution, planes_of(solution), budget.maps)}
    # A proof that was made for other networks or another problem is shown in words alone, which say so.
    bounds: dict[str, Any] = {}
    for name, proof in (("lower", _proof(directory, run.problem, networks)), ("upper", _limit(directory, run.problem))):
        if proof is not None:
            bounds[name] = proof.bound
    return found | {"line": line_maps(solution, bounds)}


def _proof(directory: RunDirectory, problem: ReachAvoidProblem, networks: str) -> LowerBound | None:
    """What was proved about the policy; None where there is nothing about these networks and this problem."""
    try:
        return LowerBound.load(directory.bound, problem, networks)
    except ProofError:
        return None


def _limit(directory: RunDirectory, problem: ReachAvoidProblem) -> UpperBound | None:
    """What was proved about all policies; None without a proof, or where it is about another problem."""
    try:
        return UpperBound.load(directory.limit_bound, problem)
    except ProofError:
        return None


def _metrics(directory: RunDirectory) -> dict[str, np.ndarray]:
    try:
        return read_metrics(directory.metrics) if directory.metrics.is_file() else {}
    except (OSError, ValueError) as error:
        raise RunError(f"{directory.metrics}: expected a table of numbers, got {error}") from error


def _overrides(directory: RunDirectory) -> list[str]:
    """The overrides of the command line that began the run; none where there is no readable record."""
    try:
        found = yaml.safe_load(directory.overrides.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError):
        return []
    return [str(entry) for entry in found] if isinstance(found, list) else []
