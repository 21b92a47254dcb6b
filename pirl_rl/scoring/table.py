"""The table of the suite: one row for each problem, over its seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pirl_rl.scoring.score import Score

HEADER = (
    "| Problem | Truth | Seeds | MSE of V | Largest error | Success | Loss of success | Largest loss | "
    "mean abs(V - MC) | of which noise | Time |\n"
    "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
)


def markdown(scores: Mapping[str, Sequence[Score]], sources: Mapping[str, str]) -> str:
    """The table in Markdown; each entry is the mean over the seeds, with the worst of them in parentheses.

    Args:
        scores: the scores of all seeds, by the name of the problem.
        sources: where the truth of each problem comes from, likewise.
    """
    return "\n".join([HEADER, *(_row(name, runs, sources[name]) for name, runs in scores.items())])


def _row(name: str, runs: Sequence[Score], source: str) -> str:
    def entry(values: Sequence[float], form: str, worst=max) -> str:
        if any(value != value for value in values):
            return ""
        mean = format(sum(values) / len(values), form)
        return mean if len(values) == 1 else f"{mean} ({format(worst(values), form)})"

    cells = [
        entry([run.mse for run in runs], ".1e"),
        entry([run.largest_error for run in runs], ".2f"),
        entry([run.success for run in runs], ".3f", min),
        entry([run.loss for run in runs], ".4f"),
        entry([run.largest_loss for run in runs], ".3f"),
        entry([run.gap for run in runs], ".4f"),
        entry([run.gap_noise for run in runs], ".4f"),
        entry([run.seconds for run in runs], ".0f") + " s",
    ]
    return f"| {name} | {source} | {len(runs)} | {' | '.join(cells)} |"
