"""Fewer operators in a graph of tensor operations, with the same results.

A runtime that evaluates one state takes about as long for an operator on a handful of numbers as for a small matrix.
"""

from __future__ import annotations

import torch
from torch.fx import Graph, Node

aten = torch.ops.aten

MADE_OF_ONES = (aten.unsqueeze.default, aten.expand.default, aten.view.default)
"""Operators that make ones of ones."""


def simplify(graph: Graph) -> None:
    """Reduce the number of operators.

    Args:
        graph: operators without side effects, with the metadata of `torch.fx.experimental.proxy_tensor.make_fx`.

    Raises:
        ValueError: an operator changes its arguments.
    """
    for node in graph.nodes:
        if isinstance(node.target, torch._ops.OpOverload) and node.target._schema.is_mutable:
            raise ValueError(f"expected operators without side effects, got {node.target}")
    _merge(graph)
    _drop_ones(graph)
    _compare_once(graph)
    graph.eliminate_dead_code()


def _merge(graph: Graph) -> None:
    """Let equal operators on equal arguments be one."""
    seen: dict[str, Node] = {}
    for node in list(graph.nodes):
        if node.op in ("call_function", "get_attr"):
            first = seen.setdefault(f"{node.target} {node.args} {node.kwargs}", node)
            if first is not node:
                node.replace_all_uses_with(first)
                graph.erase_node(node)


def _drop_ones(graph: Graph) -> None:
    """Drop products with ones, with which reverse differentiation starts."""
    ones: set[Node] = set()
    for node in list(graph.nodes):
        if node.target is aten.ones_like.default or (node.target in MADE_OF_ONES and node.args[0] in ones):
            ones.add(node)
        elif node.target is aten.mul.Tensor:
            for one, other in (node.args, node.args[::-1]):
                if one in ones and isinstance(other, Node) and other.meta["val"].shape == node.meta["val"].shape:
                    node.replace_all_uses_with(other)
                    break


def _compare_once(graph: Graph) -> None:
    """Take the largest entry and compare it with a number, in place of comparing all entries."""
    for node in list(graph.nodes):
        compared = node.args[0] if node.target is aten.all.dim else None
        if isinstance(compared, Node) and compared.target is aten.le.Scalar:
            entries, number = compared.args
            with graph.inserting_before(node):
                largest = graph.call_function(aten.amax.default, (entries, [node.args[1]], *node.args[2:]))
                node.replace_all_uses_with(graph.call_function(aten.le.Scalar, (largest, number)))
