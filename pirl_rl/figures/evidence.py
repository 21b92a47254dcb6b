"""`draw`, the function to which a class of evidence registers its figures."""

from __future__ import annotations

from collections.abc import Mapping
from functools import singledispatch

from matplotlib.figure import Figure

from pirl_rl.evaluation import Evidence


@singledispatch
def draw(evidence: object) -> dict[str, Figure]:
    """The figures of one evaluator's evidence, by name; none for a class without a registered function.

    A module registers the function that draws its class of evidence:

        @draw.register
        def draw_mine(evidence: MyEvidence) -> dict[str, Figure]: ...
    """
    return {}


def draw_all(evidence: Mapping[str, Evidence]) -> dict[str, Figure]:
    """The figures of all evidence in one dictionary, in the order of the evidence."""
    return {name: figure for entry in evidence.values() for name, figure in draw(entry).items()}
