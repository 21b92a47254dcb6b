"""States whose probability of success is bounded one by one, by many paths from each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pirl_rl.arguments import check_integer
from pirl_rl.certificates.bounds import check_level, lower_bound, upper_bound
from pirl_rl.certificates.claim import Level
from pirl_rl.certificates.deployed import Deployed, OneStart, Rngs, Starts
from pirl_rl.errors import ArgumentError

MISSED = 0.1
"""The probability that the paths of one state give a bound on the wrong side of its probability of success."""


class Bounded(NamedTuple):
    """V and one-sided bounds of the probability of success at independent states, each (N,).

    Each lower bound and each upper bound is wrong with a probability of at most `MISSED`, given the state. If the
    share of states with some fault is at least s, then a share of at least s (1 - MISSED) shows it.
    """

    value: np.ndarray
    mean: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


@dataclass(frozen=True)
class States:
    """The numbers of states and of paths from each, and the share of states about which nothing is claimed.

    Args:
        states: the number of independent states.
        rollouts: the number of paths from each.
        share: the share of the law of starts that a claim may miss, in (0, 1).

    Raises:
        ArgumentError: a number is too small, or `share` is not between 0 and 1.
    """

    states: int = 1_000
    rollouts: int = 256
    share: float = 0.05

    def __post_init__(self):
        check_integer("states", self.states, 1)
        check_integer("rollouts", self.rollouts, 1)
        check_level("share", self.share)

    @property
    def shown(self) -> float:
        """The share of states that show a fault, at least, if more than `share` have it."""
        return self.share * (1 - MISSED)

    def check(self, starts: Starts, level: Level) -> None:
        """Refuse a single start, of which no share can be missed."""
        if isinstance(starts, OneStart):
            raise ArgumentError(f"starts: expected a law for a claim about almost all states, got {starts.describe()}")

    def play(self, deployed: Deployed, starts: Starts, rngs: Rngs) -> Bounded:
        """The bounds at states that are drawn and played."""
        tau, x = starts.draw(deployed, self.states, rngs.starts)
        count = deployed.successes(tau, x, self.rollouts, rngs.noise)
        lower, upper = (bound(count, self.rollouts, 1 - MISSED) for bound in (lower_bound, upper_bound))
        return Bounded(deployed.value(tau, x), count / self.rollouts, lower, upper)
