"""A statistical certificate: claims about the frozen policy of a run and its V, with all that they depend on.

Beside its claims it may hold diagnostics, which bound nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from pirl_rl.arguments import check_integer
from pirl_rl.certificates.band import ValueBand
from pirl_rl.certificates.bounds import check_level
from pirl_rl.certificates.claim import Certifier, Claim, Level
from pirl_rl.certificates.corollary import diagnose
from pirl_rl.certificates.deployed import SEEDS, Deployed, Rngs, Starts
from pirl_rl.certificates.diagnostic import Diagnostic
from pirl_rl.certificates.success import SuccessBound
from pirl_rl.certificates.threshold import SafeThreshold
from pirl_rl.errors import ArgumentError
from pirl_rl.simulator import Simulator
from pirl_rl.solution import Solution


@dataclass(frozen=True)
class Certificate:
    """Claims by name, each of which holds alone at its confidence.

    Attributes:
        claims: the claims.
        problem: the class of the problem.
        starts: the starts in words.
        simulator: the settings of the simulator in which the policy is deployed.
        networks: the SHA-256 of the networks.
        picked_from: the number of runs that were compared on the same data.
        seed: the seed of starts and noise.
        diagnostics: what was asked for beside the claims, by name; it bounds nothing.
    """

    claims: dict[str, Claim]
    problem: str
    starts: str
    simulator: dict[str, Any]
    networks: str
    picked_from: int
    seed: int
    diagnostics: dict[str, Diagnostic] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """The certificate as plain values, for a JSON file."""
        parts = {"claims": self.claims, "diagnostics": self.diagnostics}
        return vars(self) | {key: {name: one.to_dict() for name, one in part.items()} for key, part in parts.items()}

    def lines(self) -> list[str]:
        """The sentences of all claims, and after them those of the diagnostics."""
        parts = (*self.claims.values(), *self.diagnostics.values())
        return [sentence for part in parts for sentence in part.sentences]


CLAIMS = ("success", "threshold", "band")
"""The names of the claims."""


def make_certifiers(
    claims: Sequence[str],
    episodes: int,
    at_least: float | None,
    states: int,
    rollouts: int,
    share: float,
    success: float,
) -> dict[str, Certifier]:
    """The certifiers of claims by name; see them for the arguments.

    Raises:
        ArgumentError: a claim is unknown, or an argument is out of range.
    """
    if isinstance(claims, str) or not claims or not {*claims} <= {*CLAIMS}:
        raise ArgumentError(f"claims: expected a list of names out of {', '.join(CLAIMS)}, got {claims!r}")
    certifiers: dict[str, Certifier] = {
        "success": SuccessBound(episodes, at_least),
        "threshold": SafeThreshold(states, rollouts, share, success),
        "band": ValueBand(states, rollouts, share),
    }
    return {name: certifiers[name] for name in claims}


def certify(
    solution: Solution,
    simulator: Simulator,
    starts: Starts,
    certifiers: Mapping[str, Certifier],
    confidence: float = 0.95,
    picked_from: int = 1,
    seed: int = 0,
    corollary: bool = False,
) -> Certificate:
    """Make claims about a frozen policy and its V.

    The networks must have been fixed before the seed was chosen, and a certificate must not be repeated with other
    seeds until it pleases: `picked_from` counts the runs and the seeds that were tried.

    Args:
        solution: the problem, the policy and V.
        simulator: the simulator in which the policy is deployed.
        starts: the starts of the paths.
        certifiers: the claims to make, by name.
        confidence: the level of each claim.
        picked_from: the number of runs, or seeds, out of which this one is picked on the same data.
        seed: seed of starts and noise; all claims use streams of their own.
        corollary: whether the diagnostic of `pirl_rl.certificates.corollary` is made too.

    Raises:
        ArgumentError: a level or a number is out of range.
    """
    check_level("confidence", confidence)
    check_integer("picked_from", picked_from, 1)
    check_integer("seed", seed, 0)
    if not isinstance(corollary, bool):
        raise ArgumentError(f"corollary: expected true or false, got {corollary!r}")
    level = Level(confidence, picked_from)
    # Before the paths, which take longer, all that may refuse its arguments.
    for certifier in certifiers.values():
        certifier.check(starts, level)
    diagnostics = {"corollary": diagnose(solution, simulator, confidence, SEEDS + seed)} if corollary else {}
    deployed = Deployed(solution, simulator)
    claims = {
        name: certifier(deployed, starts, level, Rngs.of(solution, len(certifiers) * seed + i))
        for i, (name, certifier) in enumerate(certifiers.items())
    }
    return Certificate(
        claims=claims,
        problem=type(solution.problem).__name__,
        starts=starts.describe(),
        simulator=deployed.describe(),
        networks=deployed.digest(),
        picked_from=picked_from,
        seed=seed,
        diagnostics=diagnostics,
    )
