"""The graph of tensor operations of a program, which runtimes execute and files hold.

It is recorded below automatic differentiation: derivatives are in it as formulas, also those of a user's level
functions, and no Python code is left.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.export import Dim, ExportedProgram
from torch.fx.experimental.proxy_tensor import make_fx

from pirl_rl.deployment.program import Program
from pirl_rl.deployment.simplify import simplify
from pirl_rl.errors import ArgumentError
from pirl_rl.solution import Solution

SAMPLE = 10_007
"""The number of states with which a graph is recorded: a prime, since equal sizes would be taken for the same size."""


def record(solution: Solution) -> ExportedProgram:
    """The graph of `Program`, for any number of states.

    Args:
        solution: the problem and the networks, on the CPU.

    Raises:
        ArgumentError: a method of the problem does what a graph cannot hold, such as a branch on the entries of a
            tensor.
    """
    problem, program = solution.problem, Program(solution)
    rng = torch.Generator().manual_seed(0)
    tau = problem.horizon * torch.rand(SAMPLE, generator=rng, dtype=solution.dtype)
    x = problem.states.sample(SAMPLE, rng, solution.dtype)
    # Boxes and problems keep tensors that they make at a first call, and those of a recording have no entries.
    program(tau, x)
    count = Dim("N", min=1)
    try:
        pure = torch.func.functionalize(program)
        graph = make_fx(pure, SIMPLER, tracing_mode="symbolic", _allow_non_fake_inputs=True)(tau, x)
        simplify(graph.graph)
        graph.recompile()
        exported = torch.export.export(graph, (tau, x), dynamic_shapes=({0: count}, {0: count}))
    except Exception as error:
        # What cannot be recorded raises errors of many types.
        reason = str(error).strip().partition("\n")[0]
        raise ArgumentError(
            f"{type(problem).__name__}: expected sets made of tensor operations alone, which a graph can hold, got "
            f"{type(error).__name__}: {reason}"
        ) from error
    for node in exported.graph.nodes:
        # It names files on this machine.
        node.meta.pop("stack_trace", None)
    return exported


def _silu_backward(grad: Tensor, z: Tensor) -> Tensor:
    """The derivative of z s is s + z s (1 - s), with the sigmoid s of z; the product z s is the activation itself."""
    s = torch.sigmoid(z)
    return grad * (s + z * s * (1 - s))


def _sigmoid_backward(grad: Tensor, y: Tensor) -> Tensor:
    """The derivative of a sigmoid y is y (1 - y)."""
    return grad * (y * (1 - y))


def _tanh_backward(grad: Tensor, y: Tensor) -> Tensor:
    """The derivative of a hyperbolic tangent y is 1 - y^2."""
    return grad * (1 - y * y)


def _select_backward(grad: Tensor, sizes: Sequence[int], dim: int, index: int) -> Tensor:
    """The gradient (*, d) of an entry of the last axis; other axes are left to torch."""
    if dim % len(sizes) != len(sizes) - 1:
        return NotImplemented
    return grad.unsqueeze(-1) * torch.eye(int(sizes[dim]), dtype=grad.dtype)[index]


def _slice_backward(grad: Tensor, sizes: Sequence[int], dim: int, start: int, end: int, step: int) -> Tensor:
    """The gradient (*, d) of a slice of the last axis; other axes are left to torch."""
    if dim % len(sizes) != len(sizes) - 1:
        return NotImplemented
    return torch.matmul(grad, torch.eye(int(sizes[dim]), dtype=grad.dtype)[start:end:step])


def _lerp(start: Tensor, end: Tensor, weight: Tensor) -> Tensor:
    """Linear interpolation by one formula, where torch has one for weights on either side of a half."""
    return start + weight * (end - start)


def _unbind(x: Tensor, dim: int = 0) -> tuple[Tensor, ...]:
    """The entries along an axis, each by one operator."""
    return tuple(x.select(dim, i) for i in range(x.shape[dim]))


SIMPLER = {
    torch.ops.aten.lerp.Tensor: _lerp,
    torch.ops.aten.unbind.int: _unbind,
    torch.ops.aten.silu_backward.default: _silu_backward,
    torch.ops.aten.sigmoid_backward.default: _sigmoid_backward,
    torch.ops.aten.tanh_backward.default: _tanh_backward,
    torch.ops.aten.select_backward.default: _select_backward,
    torch.ops.aten.slice_backward.default: _slice_backward,
}
"""Derivatives and others with fewer operators than in torch, whose derivatives fill tensors of zeros."""
