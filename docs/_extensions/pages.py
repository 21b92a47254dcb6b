"""Pages that are made from other files of the repository before Sphinx reads its sources.

They lie in `docs/_generated`, which git ignores: a page for each room of the package, filled from its docstrings; the
notebooks with the outputs that they were stored with; and texts from other folders. Links between files of
the repository work where the files lie, so that they also work in a plain view of the repository; here they are led to
the pages of the site.
"""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

from sphinx.application import Sphinx

GENERATED = "_generated"
TEXTS = {
    "README.md": "start.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "models/drift/README.md": "model_drift.md",
}
OPTIONS = ("members", "ignore-module-all", "show-inheritance")  # what a package gathers is shown where it is written
LINK = re.compile(r"\]\(((?!\w+:|#)[^)#\s]+)")


def write_reference(folder: Path, rooms: dict[str, tuple[str, list[str]]]) -> None:
    """One page of reStructuredText for each room.

    Args:
        folder: where the pages go.
        rooms: name of the page: its title and the modules on it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for page, (title, modules) in rooms.items():
        text = [title, "=" * len(title), ""]
        for module in modules:
            options = [f"   :{option}:" for option in OPTIONS]
            text += [module, "-" * len(module), "", f".. automodule:: {module}", *options, ""]
        (folder / f"{page}.rst").write_text("\n".join(text))


def copies(root: Path) -> dict[Path, Path]:
    """Files of the repository that are pages of the site, with the places of their copies."""
    folder = root / "docs" / GENERATED
    notebooks = {path: folder / "notebooks" / path.name for path in (root / "notebooks").glob("*.ipynb")}
    return {root / name: folder / copy for name, copy in TEXTS.items()} | notebooks


def relinked(text: str, page: Path, root: Path) -> str:
    """The text of a page, with its links as they have to be from the page's place."""
    placed = copies(root)
    home = next((source for source, copy in placed.items() if copy == page), page).parent

    def link(match: re.Match[str]) -> str:
        target = (home / match[1]).resolve()
        return "](" + Path(os.path.relpath(placed.get(target, target), page.parent)).as_posix()

    return LINK.sub(link, text)


def generate(app: Sphinx) -> None:
    root = Path(app.srcdir).parent
    write_reference(Path(app.srcdir) / GENERATED / "api", app.config.reference_rooms)
    for source, copy in copies(root).items():
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, copy)


def relink(app: Sphinx, name: str, content: list[str]) -> None:
    page = Path(app.env.doc2path(name))
    if page.suffix in (".md", ".ipynb"):
        content[0] = relinked(content[0], page, Path(app.srcdir).parent)


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_config_value("reference_rooms", {}, "env", types=[dict])
    app.connect("builder-inited", generate)
    app.connect("source-read", relink)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
