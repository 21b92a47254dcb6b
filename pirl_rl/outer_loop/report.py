"""Reports of an outer loop: a line for each candidate and each round, a Markdown table, and the files of a report."""

from __future__ import annotations

import re
from pathlib import Path

from pirl_rl.figures.files import save_figures
from pirl_rl.figures.tree import draw_tree
from pirl_rl.files import replacing
from pirl_rl.outer_loop.history import History, Result
from pirl_rl.outer_loop.tree import best_path, displayed_status, drawable, node_name, results_by_name, weights_text


def describe_result(result: Result, history: History) -> str:
    """A line with the status and the metrics of a candidate, and their differences from the baseline's."""
    assert result.candidate is not None
    if not result.metrics:
        return f"  {result.candidate.name}: {result.status}: {result.reason}"
    base = history.baseline.metrics
    figures = [
        f"{label} {result.metrics[name]:.4g} ({result.metrics[name] - base[name]:+.2g})"
        for label, name in (("reward", "reward"), ("success", "success_rate"), ("calibration", "calibration_mae"))
        if name in result.metrics and name in base
    ]
    return f"  {result.candidate.name}: {result.status}, weights {weights_text(result)}, {', '.join(figures)}"


def describe_round(history: History) -> str:
    """A line with the best checkpoint after the last round."""
    best, last = history.best, history.rounds[-1]
    advisor = f"{last.advisor}, as fallback" if last.fallback else last.advisor
    return (
        f"round {last.number} ({advisor}): best so far {best.checkpoint}, calibration "
        f"{best.metrics['calibration_mae']:.4g}, baseline {history.baseline.metrics['calibration_mae']:.4g}"
    )


def markdown(history: History) -> str:
    """The report in Markdown: a table of all results, then the note of each round and what failed in it."""
    names = ("reward", "success_rate", "calibration_mae", "hjb_loss", "td_loss")
    header = ["candidate", "from", "status", "TD, HJB, BC", "jitter", "replay share", "updates", *names]
    best, rows = str(history.best.checkpoint), []
    for name, result in results_by_name(history).items():
        origin = "" if result.candidate is None else result.candidate.start_checkpoint
        cells = [f"**{name}**" if name == best else name, origin, displayed_status(result, history)]
        cells += [weights_text(result)]
        cells += [_format(value) for value in (result.collocation_jitter, result.collocation_replay_share)]
        cells += [str(result.updates), *(_format(result.metrics.get(key)) for key in names)]
        rows.append(cells)
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    table = [header, ["-" * width for width in widths], *rows]
    padded = [[cell.ljust(width) for cell, width in zip(cells, widths, strict=True)] for cells in table]
    lines = ["# Outer loop", "", *(f"| {' | '.join(cells)} |" for cells in padded), ""]
    lines += [f"Best: {' → '.join(best_path(history))}. Rewards within {history.tolerance:.2g} are equal.", ""]
    for one in history.rounds:
        lines += [f"## Round {one.number}, {one.advisor}", "", f"> {_plain(one.note)}", ""]
        if one.fallback:
            lines += [f"The chosen advisor gave no plan: {_plain(one.fallback)}", ""]
        unsound = [result for result in one.results if result.reason]
        lines += [f"- {node_name(result, one.number)}: {_plain(result.reason)}" for result in unsound]
        lines += [""] if unsound else []
    return "\n".join(lines).rstrip() + "\n"


def write_report(history: History, out: Path) -> list[Path]:
    """Write `report.md` and `tree.png`; returns their paths."""
    with replacing(out / "report.md") as file:
        file.write(markdown(history))
    return [out / "report.md", *save_figures({"tree": draw_tree(*drawable(history))}, out)]


def _format(value: float | None) -> str:
    return "" if value is None else f"{value:.4g}"


def _plain(text: str) -> str:
    """Put text from outside on one line and escape the characters that Markdown interprets."""
    return re.sub(r"([\\`*_{}\[\]<>#|!])", r"\\\1", " ".join(text.split()))
