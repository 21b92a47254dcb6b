"""Functions that are compiled, and that run eagerly where no compiler is found."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from typing import Any

import torch

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


class Compiled:
    """A function that is compiled at its first call; where that fails, it runs eagerly after one warning.

    Args:
        function: maps tensors to tensors, without side effects.
        name: of the function, for the warning.
    """

    def __init__(self, function: Callable[..., Any], name: str):
        self.function, self.name, self._begun = function, name, False
        self._called: Callable[..., Any] = compiled(function, whole=True)

    def __call__(self, *args: Any) -> Any:
        if not self._begun:
            self._begun = True
            announce(f"compiling {self.name}")
        try:
            return self._called(*args)
        except Exception as error:
            if self._called is self.function or not is_compiler_failure(error):
                raise
            warnings.warn(f"{self.name} runs eagerly, which is slower: {reason_of(error)}", stacklevel=2)
            self._called = self.function
            return self.function(*args)


def rowwise(function: Callable[..., torch.Tensor], name: str) -> Callable[..., torch.Tensor]:
    """The function, compiled also where `torch.func.vmap` maps it; where gradients are taken, it runs eagerly.

    A compiled function cannot be mapped. This one gets the rows of all members at once.

    Args:
        function: maps tensors (N, ...) to a tensor (N, ...), each row by itself.
        name: of the function, for the warning of `Compiled`.
    """
    compiled_function = Compiled(function, name)

    def called(*rows: torch.Tensor) -> torch.Tensor:
        return function(*rows) if torch.is_grad_enabled() else _Rowwise.apply(compiled_function, *rows)  # type: ignore

    return called


class _Rowwise(torch.autograd.Function):
    """A function of rows without gradients, which is mapped by making one axis of the members and the rows."""

    @staticmethod
    def forward(function: Callable[..., torch.Tensor], *rows: torch.Tensor) -> torch.Tensor:  # type: ignore[override]
        return function(*rows)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        pass

    @staticmethod
    def vmap(info: Any, in_dims: Any, function: Callable[..., torch.Tensor], *rows: torch.Tensor) -> Any:
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

    return isinstance(error, (TorchDynamoException, InductorError))


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


def _filled(size: Any, **options: Any) -> torch.Tensor:
    return torch.ops.aten.full.default(size, 0, **options)
