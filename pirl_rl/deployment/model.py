"""Models as files: the graph of a solution, its description inside it, and the description beside it."""

from __future__ import annotations

import contextlib
import json
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from torch.export import ExportedProgram

from pirl_rl.deployment.description import describe
from pirl_rl.deployment.graph import record
from pirl_rl.errors import ArgumentError
from pirl_rl.files import replacing
from pirl_rl.solution import Solution

DESCRIPTION = "model.json"
"""The name of the file with the description, and of its copy inside a program of torch."""


def write_model(solution: Solution, kind: str, folder: Path) -> Path:
    """Write the model of a solution and its description into a folder.

    Args:
        solution: the problem and the networks, on the CPU.
        kind: one of `FORMATS`.
        folder: the folder; it is made where it does not exist.

    Returns:
        The path of the model.

    Raises:
        ArgumentError: the format is unknown, a package is missing, or the problem cannot be recorded as a graph.
    """
    if kind not in FORMATS:
        raise ArgumentError(f"format: expected one of {', '.join(FORMATS)}, got {kind!r}")
    folder.mkdir(parents=True, exist_ok=True)
    description = describe(solution)
    path = FORMATS[kind](lambda: record(solution), description, folder)
    with replacing(folder / DESCRIPTION) as file:
        file.write(json.dumps(description, indent=2) + "\n")
    return path


def _write_onnx(graph: Callable[[], ExportedProgram], description: Mapping[str, Any], folder: Path) -> Path:
    """An ONNX file whose metadata are the entries of the description, each as JSON."""
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
    except ModuleNotFoundError as error:
        message = f"format=onnx needs {error.name}, which is missing: pip install 'pirl_rl[export]'"
        raise ArgumentError(message) from None
    with _quiet():
        program: Any = torch.onnx.export(
            graph(),
            input_names=[*description["inputs"]],
            output_names=[*description["outputs"]],
            dynamo=True,
            verbose=False,
        )
    model = program.model
    for value in (*model.graph.inputs, *model.graph.outputs):
        value.shape = type(value.shape)(["N", *value.shape[1:]])  # the name that the description gives the size
    for part in (model.graph, *model.graph, *model.graph.inputs, *model.graph.outputs):
        part.metadata_props.clear()  # notes of the exporter, such as names of files on this machine
    model.metadata_props.update({name: json.dumps(entry) for name, entry in description.items()})
    path = folder / "model.onnx"
    program.save(path)
    return path


def _write_torch(graph: Callable[[], ExportedProgram], description: Mapping[str, Any], folder: Path) -> Path:
    """A program that `torch.export.load` opens, with the description as an extra file."""
    path = folder / "model.pt2"
    with _quiet():
        torch.export.save(graph(), path, extra_files={DESCRIPTION: json.dumps(description)})
    return path


FORMATS: dict[str, Callable[[Callable[[], ExportedProgram], Mapping[str, Any], Path], Path]] = {
    "onnx": _write_onnx,
    "torch": _write_torch,
}
"""The formats of models, with the functions that write a graph and its description into a folder."""


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Hide what the exporters say about packages and operators that models do not use."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
