"""The table of the suite: one row for each problem, over its seeds."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from pirl_rl.scoring.alternatives import Alternative
from pirl_rl.scoring.score import Score

COLUMNS = (
    "Seeds",
    "MSE of V",
    "Largest error",
    "Success",
    "Loss of success",
    "Largest loss",
    "mean abs(V - MC)",
    "of which noise",
    "Time",
)
"""The measured columns of a row."""


def markdown(
    scores: Mapping[str, Sequence[Score]],
    sources: Mapping[str, str],
    others: Mapping[str, Mapping[str, Alternative | None]] | None = None,
) -> str:
    """The table in Markdown; each entry is the mean over the seeds, with the worst of them in parentheses.

    The loss of success has its standard error, where there is one seed.

    Args:
        scores: the scores of all seeds, by the name of the problem.
        sources: where the truth of each problem comes from, likewise.
        others: what alternatives reach, by the names of the problem and the alternative; for each alternative there
            is one more column, with the success of its policy, or the time of the grid.
    """
    others = others or {}
    names = [*dict.fromkeys(name for found in others.values() for name in found)]
    titles = ["Time of the grid" if name == "grid" else f"Success of {name.upper()}" for name in names]
    lines = [_line("Problem", "Truth", *COLUMNS, *titles), _line("---", "---", *["---:"] * (len(COLUMNS) + len(names)))]
    for name, runs in scores.items():
        found = others.get(name, {})
        lines.append(_line(name, sources[name], *_measured(runs), *(_alternative(found.get(other)) for other in names)))
    return "\n".join(lines)


def _line(*cells: str) -> str:
    return f"| {' | '.join(cells)} |"


def _alternative(found: Alternative | None) -> str:
    if found is None:
        return "-"
    if math.isnan(found.success):
        return f"{found.seconds:.1f} s"
    return f"{found.success:.3f}"


def _measured(runs: Sequence[Score]) -> list[str]:
    def entry(values: Sequence[float], form: str, worst=max) -> str:
        if any(value != value for value in values):
            return ""
        mean = format(sum(values) / len(values), form)
        return mean if len(values) == 1 else f"{mean} ({format(worst(values), form)})"

    loss = entry([run.loss for run in runs], ".4f")
    if len(runs) == 1 and loss:
        loss += f" ± {runs[0].loss_error:.4f}"
    return [
        str(len(runs)),
        entry([run.mse for run in runs], ".1e"),
        entry([run.largest_error for run in runs], ".2f"),
        entry([run.success for run in runs], ".3f", min),
        loss,
        entry([run.largest_loss for run in runs], ".3f"),
        entry([run.gap for run in runs], ".4f"),
        entry([run.gap_noise for run in runs], ".4f"),
        entry([run.seconds for run in runs], ".0f") + " s",
    ]
