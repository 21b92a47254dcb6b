"""The figure of an outer loop: a tree of results, with one column for each round."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

BEST = "#1b6e3c"
WIDTH, HEIGHT, LANE = 0.8, 0.8, 0.3
"""Width and height of a node's box, and height of a lane in which an edge passes a column. The units are the distances
between columns and between rows."""

Place = tuple[float, float]


@dataclass(frozen=True)
class Node:
    """A result in the tree.

    Attributes:
        name: unique in the tree.
        column: index of its column, 0 for the root.
        origin: name of the node that it started from, in an earlier column; None for the root.
        label: the text in its box, of one or several lines.
        color: colour of its box.
        best: whether it is on the path to the best result.
    """

    name: str
    column: int
    origin: str | None
    label: str
    color: str
    best: bool


def draw_tree(nodes: Sequence[Node], columns: Sequence[str], title: str) -> Figure:
    """Draw a box for each node and an edge from its origin; the path to the best result is bold.

    Args:
        nodes: the root, then the nodes of all columns in the order in which they were made.
        columns: names of the columns.
        title: title of the figure.
    """
    places = _places(nodes)
    rows = 2 * max(abs(y) for _, y in places.values()) + 1
    figure = Figure(figsize=(max(5.5, 2.5 * len(columns)), 1.0 + 1.15 * rows), layout="constrained")
    axes = figure.add_subplot()
    for node in nodes:
        x, y = places[node.name, -1]
        if node.origin is not None:
            edge, color = _edge(places, node.origin, node.name), BEST if node.best else "0.6"
            axes.plot(*zip(*edge, strict=True), color=color, lw=2.5 if node.best else 1, zorder=1 + node.best)
        box = Rectangle((x - WIDTH / 2, y - HEIGHT / 2), WIDTH, HEIGHT, linewidth=2.5 if node.best else 0.8, zorder=3)
        box.set(facecolor=node.color, edgecolor=BEST if node.best else "0.5")
        axes.add_patch(box)
        axes.text(x, y, node.label, ha="center", va="center", fontsize=7.5, zorder=4, linespacing=1.35)
    axes.set(xlim=(-0.5, len(columns) - 0.5), ylim=(-rows / 2, rows / 2))
    axes.set_xticks(range(len(columns)), columns)
    axes.set_yticks([])
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.set_title(title, fontsize=8)
    return figure


def _places(nodes: Sequence[Node]) -> dict[tuple[str, int], Place]:
    """Centres (x, y) of nodes, by (name, -1), and of the lanes of edges that pass a column, by (origin, column).

    The entries of a column are sorted by the height at which their edges start, so that few edges cross.
    """
    root, *others = nodes
    places: dict[tuple[str, int], Place] = {(root.name, -1): (0.0, 0.0)}
    column_of = {node.name: node.column for node in nodes}
    for column in sorted({node.column for node in others}):
        origins = {(node.name, -1): _origin(node) for node in others if node.column == column}
        later = (_origin(node) for node in others if node.column > column)
        origins |= {(origin, column): origin for origin in later if column_of[origin] < column}

        def height(entry: tuple[str, int], origins=origins, column=column) -> float:
            origin = origins[entry]
            return places.get((origin, column - 1), places[origin, -1])[1]

        entries = sorted(origins, key=lambda entry: -height(entry))
        sizes = [1.0 if lane == -1 else LANE for _, lane in entries]
        top = sum(sizes) / 2
        for entry, size in zip(entries, sizes, strict=True):
            places[entry] = (float(column), top - size / 2)
            top -= size
    return places


def _origin(node: Node) -> str:
    assert node.origin is not None, f"{node.name} has no origin, only the root has none"
    return node.origin


def _edge(places: dict[tuple[str, int], Place], origin: str, name: str) -> list[Place]:
    """The points of the edge from the right side of `origin`, along its lanes, to the left side of `name`."""
    (x0, y0), (x1, y1) = places[origin, -1], places[name, -1]
    lanes = [places[origin, column] for column in range(round(x0) + 1, round(x1))]
    passing = [(x + side * WIDTH / 2, y) for x, y in lanes for side in (-1, 1)]
    return [(x0 + WIDTH / 2, y0), *passing, (x1 - WIDTH / 2, y1)]
