"""Work on a CUDA device that is recorded as one graph of kernels and replayed by one launch.

The networks of this package are small. A GPU computes a kernel of an update in a few microseconds, and Python takes
longer to launch it, so that launches are nearly all of the time. A recorded CUDA graph is replayed by one launch.

What is recorded must ask nothing of the device: no number may come back from it, and no number may go to it that
changes from one replay to the next. All that changes lies in tensors whose memory stays where it is.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import torch

KEPT = 4
"""The number of recordings that an object keeps: updates with and without the actor's, before and after a change."""

Work = Callable[[], Any]
"""A function without arguments, whose results are tensors on the device, alone or in containers."""


def records(device: torch.device) -> bool:
    """Whether work on a device is recorded."""
    return device.type == "cuda"


class Recorded:
    """A function that does its work directly when it is called first, and by replays of a recording from then on.

    The first call makes what a recording cannot make: programs are compiled, and optimisers allocate their memory. The
    results of a replay lie in the memory of those of the one before. Where a recording fails, as where a function of
    the problem copies numbers to the device or asks for one of its results, all calls work directly, after a warning.

    Args:
        work: the function. What it changes must be tensors that it changes in place.
        name: what the function does, for the warning.
        generators: the random generators on the device that it draws from, beside torch's default one.
    """

    def __init__(self, work: Work, name: str, generators: Sequence[torch.Generator] = ()):
        self.work, self.name, self.generators = work, name, generators
        self._calls, self._graph, self._result = 0, None, None

    def __call__(self) -> Any:
        self._calls += 1
        if self._calls == 2:
            self._record()
        if self._graph is None:
            return self.work()
        self._graph.replay()
        return self._result

    def _record(self) -> None:
        graph = torch.cuda.CUDAGraph()
        for generator in self.generators:
            graph.register_generator_state(generator)
        drawn = (*self.generators, torch.cuda.default_generators[torch.cuda.current_device()])
        before = [generator.clone_state() for generator in drawn]
        try:
            with torch.cuda.graph(graph):
                self._result = self.work()
        except RuntimeError as error:
            # Generators are left in a state in which they draw for a recording alone.
            for generator, state in zip(drawn, before, strict=True):
                generator.graphsafe_set_state(state)
            reason = str(error).partition("\n")[0]
            warnings.warn(f"{self.name} runs without a graph of kernels, which is slower: {reason}", stacklevel=3)
        else:
            self._graph = graph


class Recordings:
    """One recording for each kind of work that an object does, of which the latest `KEPT` are kept.

    Args:
        name: see `Recorded`.
        generators: see `Recorded`.
    """

    def __init__(self, name: str, generators: Sequence[torch.Generator] = ()):
        self.name, self.generators = name, generators
        self._recorded: dict[Hashable, Recorded] = {}

    def __call__(self, kind: Hashable, work: Work) -> Any:
        """Do work of a kind; all work of one kind has the same kernels on the same memory."""
        if kind not in self._recorded:
            self._recorded[kind] = Recorded(work, self.name, self.generators)
            while len(self._recorded) > KEPT:
                del self._recorded[next(iter(self._recorded))]
        return self._recorded[kind]()

    def forget(self) -> None:
        """Drop all recordings, since what they have recorded has changed."""
        self._recorded.clear()


def renewed(number: Any, value: float) -> Any:
    """The value, or where a tensor holds the number before, this tensor with the value."""
    return number.fill_(value) if isinstance(number, torch.Tensor) else value
