"""`draw`: the figures of any evidence."""

from __future__ import annotations

from collections.abc import Mapping
from functools import singledispatch

from matplotlib.figure import Figure

from pirl_rl.evaluation import Evidence


@singledispatch
def draw(evidence: object) -> dict[str, Figure]:
    """The figures of one piece of evidence, by name; none of a class that nobody has registered a function for.

    A module registers what draws its own evidence:

        @draw.register
        def draw_mine(evidence: MyEvidence) -> dict[str, Figure]: ...
    """
    return {}


def draw_all(evidence: Mapping[str, Evidence]) -> dict[str, Figure]:
    """The figures of all evidence in one dictionary, in its order."""
    return {name: figure for one in evidence.values() for name, figure in draw(one).items()}
