"""The tree of a loop's results: which started from which, and what its figure shows of each."""

from __future__ import annotations

from pirl_rl.figures.tree import Node
from pirl_rl.outer_loop.history import History, Result
from pirl_rl.outer_loop.plan import START

COLORS = {"done": "#dcebdc", "worse": "#f6e7c8", "collapsed": "#f3cfc4", "failed": "#dddddd", START: "#d8e4f2"}
"""Of a node: "worse" is done, but with less reward than the baseline."""


def node_name(result: Result, number: int) -> str:
    """A result's name in the tree; `number` is its round, 0 for the start."""
    return START if result.candidate is None else f"{number:03d}/{result.candidate.name}"


def results(history: History) -> dict[str, Result]:
    """All results by name, the start first."""
    found = {node_name(history.baseline, 0): history.baseline}
    return found | {node_name(result, one.number): result for one in history.rounds for result in one.results}


def best_path(history: History) -> list[str]:
    """Names from the start to the best result."""
    tree, path = results(history), [str(history.best.checkpoint)]
    while (candidate := tree[path[0]].candidate) is not None:
        path.insert(0, candidate.start_checkpoint)
    return path


def drawable(history: History) -> tuple[list[Node], list[str], str]:
    """What `pirl_rl.figures.tree.draw_tree` draws: the nodes, the names of the columns, and the title."""
    path, column = best_path(history), {node_name(history.baseline, 0): 0}
    column |= {node_name(result, one.number): one.number for one in history.rounds for result in one.results}
    nodes = [
        Node(
            name=name,
            column=column[name],
            origin=None if result.candidate is None else result.candidate.start_checkpoint,
            label=_label(name, result),
            color=COLORS[status(result, history)],
            best=name in path,
        )
        for name, result in results(history).items()
    ]
    columns = ["start", *(f"round {one.number}" for one in history.rounds)]
    return nodes, columns, "weights TD, HJB, boundary in force at the end; MAE: mean |Monte Carlo - V|"


def _label(name: str, result: Result) -> str:
    name = name.partition("/")[2] or name
    lines = [name if len(name) <= 24 else f"{name[:23]}…", weights(result)]
    if "calibration_mae" in result.metrics:
        lines += [f"success {result.metrics.get('success_rate', float('nan')):.3f}"]
        lines += [f"MAE {result.metrics['calibration_mae']:.4f}"]
    return "\n".join([*lines, *([result.status] if result.status != "done" else [])])


def status(result: Result, history: History) -> str:
    if result.candidate is None:
        return START
    return "worse" if result.status == "done" and not history.keeps(result) else result.status


def weights(result: Result) -> str:
    return ", ".join(f"{weight:.3g}" for weight in result.weights)
