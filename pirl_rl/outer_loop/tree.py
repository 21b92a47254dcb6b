"""The tree of a loop's results, in which each result is a child of the one from which it started."""

from __future__ import annotations

from pirl_rl.figures.tree import Node
from pirl_rl.outer_loop.history import History, Result
from pirl_rl.outer_loop.plan import START

COLORS = {"done": "#dcebdc", "worse": "#f6e7c8", "collapsed": "#f3cfc4", "failed": "#dddddd", START: "#d8e4f2"}
"""Colours of nodes by displayed status."""


def node_name(result: Result, round_number: int) -> str:
    """The name of a result in the tree; the start has the round number 0."""
    return START if result.candidate is None else f"{round_number:03d}/{result.candidate.name}"


def results_by_name(history: History) -> dict[str, Result]:
    """All results by their names in the tree, the start first."""
    start = {node_name(history.baseline, 0): history.baseline}
    return start | {node_name(result, one.number): result for one in history.rounds for result in one.results}


def best_path(history: History) -> list[str]:
    """The names of the results from the start to the best one."""
    tree, path = results_by_name(history), [str(history.best.checkpoint)]
    while (candidate := tree[path[0]].candidate) is not None:
        path.insert(0, candidate.start_checkpoint)
    return path


def drawable(history: History) -> tuple[list[Node], list[str], str]:
    """The arguments of `pirl_rl.figures.tree.draw_tree`: the nodes, the names of the columns, and the title."""
    path, column = best_path(history), {node_name(history.baseline, 0): 0}
    column |= {node_name(result, one.number): one.number for one in history.rounds for result in one.results}
    nodes = [
        Node(
            name=name,
            column=column[name],
            origin=None if result.candidate is None else result.candidate.start_checkpoint,
            label=_label(name, result),
            color=COLORS[displayed_status(result, history)],
            best=name in path,
        )
        for name, result in results_by_name(history).items()
    ]
    columns = ["start", *(f"round {one.number}" for one in history.rounds)]
    return nodes, columns, "weights TD, HJB, boundary in force at the end; MAE: mean |Monte Carlo - V|"


def _label(name: str, result: Result) -> str:
    name = name.partition("/")[2] or name
    lines = [name if len(name) <= 24 else f"{name[:23]}…", weights_text(result)]
    if "calibration_mae" in result.metrics:
        lines += [f"success {result.metrics.get('success_rate', float('nan')):.3f}"]
        lines += [f"MAE {result.metrics['calibration_mae']:.4f}"]
    return "\n".join([*lines, *([result.status] if result.status != "done" else [])])


def displayed_status(result: Result, history: History) -> str:
    """The status of a result, "start" for the loop's start, or "worse" for one that is done with too little reward."""
    if result.candidate is None:
        return START
    return "worse" if result.status == "done" and not history.keeps(result) else result.status


def weights_text(result: Result) -> str:
    """The loss weights (TD, HJB, boundary) in force at the end, as text."""
    return ", ".join(f"{weight:.3g}" for weight in result.weights)
