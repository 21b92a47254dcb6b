"""Functions that are compiled, and that run eagerly where no compiler is found."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils._pytree import tree_flatten, tree_unflatten

from pirl_rl.progress import announce

FRAME = re.compile(r'File "(.+)", line (\d+)')
"""A place in the code, in the messages of the compiler."""


def compiled(function: Callable[..., Any], whole: bool = False) -> Callable[..., Any]:
    """The function, compiled at its first call for the shapes that it gets.

    Each result has programs of its own: trainings of many problems in one process would otherwise share, and exhaust,
    the small number that the compiler keeps for one function. Shapes are constants, because derivatives of the physics
    in forward mode do not compile for others.

    Args:
        function: maps tensors to tensors.
        whole: whether a function that cannot be compiled as one program is an error. Otherwise it becomes many small
            ones, which together may be slower than none.
    """
    _give_zeros_memory()
    _trace_gradients()
    # PyTorch's own overloads lack the last argument.
    return torch.compile(function, fullgraph=whole, dynamic=False, isolate_recompiles=True)  # pyright: ignore


class TraceError(Exception):
    """The operations of a function cannot be traced."""


class Traced:
    """A function that is compiled from traces of its operations, one for each kind of arguments.

    The compiler reads the Python code of a function, and where `torch.func.vmap` maps it, that takes twenty times as
    long as a trace. A trace has the operations of one call. In another call only the numbers in the given tensors may
    differ, and the function must decide nothing by them. `vmap` refuses functions that do, so that what it maps can be
    traced.

    The results have no gradient; the function itself may contain `torch.autograd.grad`.

    Args:
        function: maps tensors, alone or in containers, to tensors, alone or in containers.
    """

    def __init__(self, function: Callable[..., Any]):
        self.function = function
        self._programs: dict[Any, tuple[Callable[..., list[Tensor]], Any]] = {}

    def __call__(self, *args: Any) -> Any:
        leaves, structure = tree_flatten(args)
        tensors = [leaf for leaf in leaves if isinstance(leaf, Tensor)]
        kind = structure, *(_kind(leaf) for leaf in leaves)
        if kind not in self._programs:
            self._programs[kind] = self._traced(leaves, structure, tensors)
        program, results = self._programs[kind]
        with torch.no_grad():
            return tree_unflatten(_filled_in(results[0], program(*tensors)), results[1])

    def _traced(self, leaves: list[Any], structure: Any, tensors: list[Tensor]) -> tuple[Callable[..., Any], Any]:
        """The compiled trace, from tensors to the tensors among the results, and the results with blanks for them."""
        blanks, results = _with_blanks(leaves), []

        def flat(*given: Tensor) -> list[Tensor]:
            found, shape = tree_flatten(self.function(*tree_unflatten(_filled_in(blanks, given), structure)))
            results[:] = _with_blanks(found), shape
            return [leaf for leaf in found if isinstance(leaf, Tensor)]

        own = [tensor.detach().requires_grad_(tensor.requires_grad) for tensor in tensors]
        try:
            graph = make_fx(flat)(*own)
        except Exception as error:
            raise TraceError(str(error)) from error
        return compiled(graph, whole=True), results


def _kind(leaf: Any) -> Any:
    """What decides which program a leaf needs: of a tensor all but its numbers, of anything else the thing itself."""
    if not isinstance(leaf, Tensor):
        return leaf
    return Tensor, leaf.shape, leaf.stride(), leaf.dtype, leaf.device, leaf.requires_grad


def _with_blanks(leaves: Sequence[Any]) -> list[Any]:
    """The leaves with the class `Tensor` as a blank in the place of each tensor."""
    return [Tensor if isinstance(leaf, Tensor) else leaf for leaf in leaves]


def _filled_in(leaves: Sequence[Any], tensors: Sequence[Tensor]) -> list[Any]:
    """Leaves of `_with_blanks` with tensors in the blanks."""
    new = iter(tensors)
    return [next(new) if leaf is Tensor else leaf for leaf in leaves]


class Compiled:
    """A function that is compiled at its first call; where that fails, it runs eagerly after one warning.

    Args:
        function: maps tensors to tensors, without side effects.
        name: of the function, for the warning.
        traced: whether it is compiled from a trace, see `Traced`.
    """

    def __init__(self, function: Callable[..., Any], name: str, traced: bool = False):
        self.function, self.name, self._begun = function, name, False
        self._called: Callable[..., Any] = Traced(function) if traced else compiled(function, whole=True)

    def __call__(self, *args: Any) -> Any:
        if not self._begun:
            self._begun = True
            announce(f"compiling {self.name}")
        try:
            return self._called(*args)
        except Exception as error:
            if self._called is self.function or not is_compiler_failure(error):
                raise
            result = self.function(*args)  # where the function itself is wrong, its error comes without a warning
            warnings.warn(f"{self.name} runs eagerly, which is slower: {reason_of(error)}", stacklevel=2)
            self._called = self.function
            return result


def rowwise(function: Callable[..., Tensor], name: str) -> Callable[..., Tensor]:
    """The function, compiled also where `torch.func.vmap` maps it; where gradients are taken, it runs eagerly.

    A compiled function cannot be mapped. This one gets the rows of all members at once.

    Args:
        function: maps tensors (N, ...) to a tensor (N, ...), each row by itself.
        name: of the function, for the warning of `Compiled`.
    """
    compiled_function = Compiled(function, name)

    def called(*rows: Tensor) -> Tensor:
        return function(*rows) if torch.is_grad_enabled() else _Rowwise.apply(compiled_function, *rows)  # type: ignore

    return called


class _Rowwise(torch.autograd.Function):
    """A function of rows without gradients, which is mapped by making one axis of the members and the rows."""

    @staticmethod
    def forward(function: Callable[..., Tensor], *rows: Tensor) -> Tensor:  # type: ignore[override]
        return function(*rows)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        pass

    @staticmethod
    def vmap(info: Any, in_dims: Any, function: Callable[..., Tensor], *rows: Tensor) -> Any:
        members = info.batch_size
        moved = [
            row.expand(members, *row.shape) if axis is None else row.movedim(axis, 0)
            for row, axis in zip(rows, in_dims[1:], strict=True)
        ]
        result = _Rowwise.apply(function, *(row.flatten(0, 1) for row in moved))
        return result.unflatten(0, (members, -1)), 0  # type: ignore[union-attr]


def is_compiler_failure(error: Exception) -> bool:
    """Whether an error comes from the compiler, as without a C++ compiler, and not from the compiled function."""
    # The compiler takes a second to import, which commands that compile nothing need not spend.
    from torch._dynamo.exc import TorchDynamoException
    from torch._inductor.exc import InductorError

    return isinstance(error, (TorchDynamoException, InductorError, TraceError))


def reason_of(error: Exception) -> str:
    """What the compiler could not do, and the line of code, in one line."""
    text = str(error)
    places = FRAME.findall(text)
    return text.partition("\n")[0] + (f" ({places[-1][0]}, line {places[-1][1]})" if places else "")


def _give_zeros_memory() -> None:
    """Let compiled programs fill a tensor of zeros that eager code keeps without memory.

    The forward mode of functions with several arguments, such as `torch.lerp`, takes such a tensor for the derivative
    of an argument that does not vary. A compiled program would read it at the address 0, and the process would end with
    a segmentation fault (https://github.com/pytorch/pytorch/issues/197067).
    """
    # The import takes a second, which commands that compile nothing need not spend.
    from torch._inductor.decomposition import decompositions

    decompositions.setdefault(torch.ops.aten._efficientzerotensor.default, _filled)


def _trace_gradients() -> None:
    """Let compiled programs contain `torch.autograd.grad`, so that a loss and its gradient are one program."""
    # The import takes a second, which commands that compile nothing need not spend.
    import torch._dynamo.config

    torch._dynamo.config.trace_autograd_ops = True


def _filled(size: Any, **options: Any) -> Tensor:
    return torch.ops.aten.full.default(size, 0, **options)
