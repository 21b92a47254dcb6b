"""The tree of a loop's results, and its figure."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from pirl_rl.outer_loop.history import History, Result
from pirl_rl.outer_loop.plan import START

COLORS = {"done": "#dcebdc", "worse": "#f6e7c8", "collapsed": "#f3cfc4", "failed": "#dddddd", START: "#d8e4f2"}
"""Of a node: "worse" is done, but with less reward than the baseline."""

BEST = "#1b6e3c"
WIDTH, HEIGHT, LANE = 0.8, 0.8, 0.3
"""Of a node's box, and the height of a lane for edges that pass a column, in distances of columns and rows."""

Place = tuple[float, float]


def node(result: Result, number: int) -> str:
    """A result's name in the tree; `number` is its round, 0 for the start."""
    return START if result.candidate is None else f"{number:03d}/{result.candidate.name}"


def nodes(history: History) -> dict[str, Result]:
    """All results by name, the start first."""
    found = {node(history.baseline, 0): history.baseline}
    return found | {node(result, one.number): result for one in history.rounds for result in one.results}


def best_path(history: History) -> list[str]:
    """Names from the start to the best result."""
    tree, path = nodes(history), [str(history.best.checkpoint)]
    while (candidate := tree[path[0]].candidate) is not None:
        path.insert(0, candidate.start_checkpoint)
    return path


def draw_tree(history: History) -> Figure:
    """One column for each round, one box for each result, edges from where it started; the best path is drawn bold."""
    places, path = _places(history), best_path(history)
    rows = 2 * max(abs(y) for _, y in places.values()) + 1
    figure = Figure(figsize=(max(5.5, 2.5 * (1 + len(history.rounds))), 1.0 + 1.15 * rows), layout="constrained")
    axes = figure.add_subplot()
    for name, result in nodes(history).items():
        x, y = places[name, -1]
        best = name in path
        if result.candidate is not None:
            edge = _edge(places, result.candidate.start_checkpoint, name)
            axes.plot(*zip(*edge, strict=True), color=BEST if best else "0.6", lw=2.5 if best else 1, zorder=1 + best)
        box = Rectangle((x - WIDTH / 2, y - HEIGHT / 2), WIDTH, HEIGHT, linewidth=2.5 if best else 0.8, zorder=3)
        box.set(facecolor=COLORS[status(result, history)], edgecolor=BEST if best else "0.5")
        axes.add_patch(box)
        axes.text(x, y, _label(name, result), ha="center", va="center", fontsize=7.5, zorder=4, linespacing=1.35)
    axes.set(xlim=(-0.5, len(history.rounds) + 0.5), ylim=(-rows / 2, rows / 2))
    axes.set_xticks(range(1 + len(history.rounds)), ["start", *(f"round {one.number}" for one in history.rounds)])
    axes.set_yticks([])
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.set_title("weights TD, HJB, boundary in force at the end; MAE: mean |Monte Carlo - V|", fontsize=8)
    return figure


def _places(history: History) -> dict[tuple[str, int], Place]:
    """Centres: (name, -1) of a node, (name, column) of the lane on which edges from that node pass a column.

    A column is centred, and in the order of where its edges come from, so that few of them cross.
    """
    places: dict[tuple[str, int], Place] = {(START, -1): (0.0, 0.0)}
    columns = {one.number: {node(result, one.number): result for result in one.results} for one in history.rounds}
    born = {START: 0} | {name: number for number, column in columns.items() for name in column}
    for number, column in columns.items():
        origins = {(name, -1): _origin(result) for name, result in column.items()}
        later = (_origin(result) for after, other in columns.items() if after > number for result in other.values())
        origins |= {(origin, number): origin for origin in later if born[origin] < number}

        def height(entry: tuple[str, int], origins=origins, number=number) -> float:
            origin = origins[entry]
            return places.get((origin, number - 1), places[origin, -1])[1]

        entries = sorted(origins, key=lambda entry: -height(entry))
        sizes = [1.0 if column_of == -1 else LANE for _, column_of in entries]
        top = sum(sizes) / 2
        for entry, size in zip(entries, sizes, strict=True):
            places[entry] = (float(number), top - size / 2)
            top -= size
    return places


def _origin(result: Result) -> str:
    return START if result.candidate is None else result.candidate.start_checkpoint


def _edge(places: dict[tuple[str, int], Place], origin: str, name: str) -> list[Place]:
    """From the right side of one node, along its lanes, to the left side of another."""
    (x0, y0), (x1, y1) = places[origin, -1], places[name, -1]
    lanes = [places[origin, column] for column in range(round(x0) + 1, round(x1))]
    passing = [(x + side * WIDTH / 2, y) for x, y in lanes for side in (-1, 1)]
    return [(x0 + WIDTH / 2, y0), *passing, (x1 - WIDTH / 2, y1)]


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
