"""What came of a loop, in words: a line for each candidate, a Markdown table, and the files of a report."""

from __future__ import annotations

import re
from pathlib import Path

from pirl_rl.figures.run import save_figures
from pirl_rl.files import replacing
from pirl_rl.outer_loop.history import History, Result
from pirl_rl.outer_loop.tree import best_path, draw_tree, node, nodes, status, weights


def line(result: Result, history: History) -> str:
    """What came of a candidate, beside the baseline."""
    assert result.candidate is not None
    if not result.metrics:
        return f"  {result.candidate.name}: {result.status}: {result.reason}"
    base = history.baseline.metrics
    figures = [
        f"{label} {result.metrics[name]:.4g} ({result.metrics[name] - base[name]:+.2g})"
        for label, name in (("reward", "reward"), ("success", "success_rate"), ("calibration", "calibration_mae"))
        if name in result.metrics and name in base
    ]
    return f"  {result.candidate.name}: {result.status}, weights {weights(result)}, {', '.join(figures)}"


def verdict(history: History) -> str:
    """Where a round leaves the loop."""
    best, one = history.best, history.rounds[-1]
    by = f"{one.advisor}, stepping in" if one.fallback else one.advisor
    return (
        f"round {one.number} ({by}): best so far {best.checkpoint}, calibration "
        f"{best.metrics['calibration_mae']:.4g}, baseline {history.baseline.metrics['calibration_mae']:.4g}"
    )


def markdown(history: History) -> str:
    """The table of all results, then what the rounds' notes say."""
    names = ("reward", "success_rate", "calibration_mae", "hjb_loss", "td_loss")
    header = ["candidate", "from", "status", "TD, HJB, BC", "jitter", "replay share", "updates", *names]
    best, rows = str(history.best.checkpoint), []
    for name, result in nodes(history).items():
        origin = "" if result.candidate is None else result.candidate.start_checkpoint
        cells = [f"**{name}**" if name == best else name, origin, status(result, history), weights(result)]
        cells += [_number(value) for value in (result.collocation_jitter, result.collocation_replay_share)]
        cells += [str(result.updates), *(_number(result.metrics.get(key)) for key in names)]
        rows.append(cells)
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    table = [header, ["-" * width for width in widths], *rows]
    padded = [[cell.ljust(width) for cell, width in zip(cells, widths, strict=True)] for cells in table]
    lines = ["# Outer loop", "", *(f"| {' | '.join(cells)} |" for cells in padded), ""]
    lines += [f"Best: {' → '.join(best_path(history))}. Rewards within {history.tolerance:.2g} are equal.", ""]
    for one in history.rounds:
        lines += [f"## Round {one.number}, {one.advisor}", "", f"> {_plain(one.note)}", ""]
        if one.fallback:
            lines += [f"The advisor that was asked gave no plan: {_plain(one.fallback)}", ""]
        reasons = [f"- {node(result, one.number)}: {_plain(result.reason)}" for result in one.results if result.reason]
        lines += [*reasons, ""] if reasons else []
    return "\n".join(lines).rstrip() + "\n"


def write_report(history: History, out: Path) -> list[Path]:
    """Write `report.md` and `tree.png`; returns their paths."""
    with replacing(out / "report.md") as file:
        file.write(markdown(history))
    return [out / "report.md", *save_figures({"tree": draw_tree(history)}, out)]


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def _plain(text: str) -> str:
    """Outside text on one line, without any meaning in Markdown."""
    return re.sub(r"([\\`*_{}\[\]<>#|!])", r"\\\1", " ".join(text.split()))
