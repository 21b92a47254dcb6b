"""The page: one file with everything in it, which loads nothing from elsewhere."""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, FileSystemLoader, StrictUndefined, UndefinedError
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from pirl_rl.errors import ArgumentError, RunError
from pirl_rl.files import replacing
from pirl_rl.machine import version_of
from pirl_rl.problem import ReachAvoidProblem
from pirl_rl.reports.contents import Budget, Contents
from pirl_rl.reports.packing import compressed
from pirl_rl.run_directory import RunDirectory

TEMPLATES = Path(__file__).parent / "templates"

LARGEST = 5_000_000
"""The largest size of a page in bytes."""

MAPS, PICTURES = 3_200_000, 900_000
"""The budget of all runs of a page: bytes of maps before compression, and characters of pictures."""

SHARES = (1.0, 0.5, 0.2)
"""The shares of the budget that are tried until the page is small enough."""

MOST_RUNS = 6
"""The largest number of runs side by side; with more, each would have too little of the page."""

SCRIPTS = ("start.js", "charts.js", "maps.js", "planes.js", "line.js", "begin.js")
"""The scripts of the page, in the order in which they run."""

WORDS = {None: "none", True: "yes", False: "no"}


class Entry(NamedTuple):
    """An entry of a JSON file of a run.

    Attributes:
        source: the file and the path of the entry, such as "certificate.json:claims.success.lower".
        value: the entry.
        text: the entry as it is shown, numbers with five digits.
    """

    source: str
    value: Any
    text: str


def write_report(
    folders: Sequence[str | PathLike[str]],
    out: str | PathLike[str],
    trust: Sequence[str] = (),
    problem: ReachAvoidProblem | None = None,
) -> Path:
    """Draw a report of one run, or of several side by side, and write it whole or not at all.

    Args:
        folders: the run directories.
        out: the file.
        trust: modules outside pirl_rl that the configurations may name.
        problem: replaces `env.problem`, for a run that was trained on an object.

    Raises:
        ArgumentError: there is no run, or there are too many.
        PirlError: a directory holds no run that can be opened, a link leads out of it, a file is broken, or the page
            would be too large.
        OSError: the file cannot be written.
    """
    if not 1 <= len(folders) <= MOST_RUNS:
        raise ArgumentError(f"run: expected 1 to {MOST_RUNS} run directories, got {len(folders)}")
    for share in SHARES:
        budget = Budget(int(share * MAPS / len(folders)), int(share * PICTURES / len(folders)))
        text = render([Contents.of(Path(folder), budget, trust, problem) for folder in folders], trust)
        if len(text.encode()) <= LARGEST:
            break
    else:
        raise RunError(f"report: expected a page of at most {LARGEST:,} bytes, got {len(text.encode()):,}")
    path = Path(out)
    with replacing(path) as file:
        file.write(text)
    return path


def render(runs: Sequence[Contents], trust: Sequence[str] = ()) -> str:
    """The page as text.

    Raises:
        RunError: a certificate or a proof lacks an entry.
    """
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["lines"] = str.splitlines
    library = get_plotlyjs()
    script = "\n".join((TEMPLATES / name).read_text(encoding="utf-8") for name in SCRIPTS)
    try:
        return environment.get_template("page.html.j2").render(
            runs=runs,
            entry=entry,
            trust=trust,
            version=version_of("pirl_rl"),
            style=Markup((TEMPLATES / "page.css").read_text(encoding="utf-8")),
            script=Markup(script),
            library=Markup(compressed(library.encode())),
            hashes=[_hash(script), _hash(library)],
        )
    except UndefinedError as error:
        files = (RunDirectory.CERTIFICATE, RunDirectory.PROOF, RunDirectory.LIMIT)
        names = " or ".join(str(name) for name in files)
        raise RunError(f"report: expected all entries of {names}, got one without: {error}") from error


def _hash(script: str) -> str:
    """The name by which the page's policy allows a script, so that no other can run."""
    return f"sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode('ascii')}"


def entry(run: Contents, file: str, *path: str) -> Entry | None:
    """An entry of a JSON file of a run, by its path; None where there is no such entry."""
    value: Any = run.files.get(file)
    for name in path:
        if not isinstance(value, dict) or name not in value:
            return None
        value = value[name]
    return Entry(f"{file}:{'.'.join(path)}", value, shown(value))


def shown(value: Any) -> str:
    """A value as a page shows it."""
    if value is None or isinstance(value, bool):
        return WORDS[value]
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.5g}" if math.isfinite(value) else "not a number" if math.isnan(value) else "infinite"
    if isinstance(value, list):
        return f"[{', '.join(shown(item) for item in value)}]"
    return str(value)
