"""Docstrings of this project are plain text in Google's style; this turns them into reStructuredText for autodoc.

- `` `code` `` becomes a link where it names an object of the package, and code in any case.
- `Eq. (label)` becomes a link to that equation of the theory page.
- Indented blocks between paragraphs, which hold equations and layouts, stay as they are.
- `*`, `|` and a trailing `_` are letters: shapes such as (*, n), norms such as |x|.
"""

from __future__ import annotations

import re

from sphinx.application import Sphinx

SECTION = re.compile(r"(Args|Attributes|Returns|Raises|Yields|Example|Examples|Note|References):$")
TOKEN = re.compile(r"(?P<code>`[^`]+`)|Eq\. \((?P<label>\w+)\)|(?P<mark>[*|\\]|_(?!\w))")
NAME = re.compile(r"[A-Za-z_][\w.]*(\(\))?")


def restructured(lines: list[str]) -> list[str]:
    """The same docstring, line by line, as napoleon and docutils want it."""
    result: list[str] = []
    section = literal = False
    for line in lines:
        indent = len(line) - len(line.lstrip())
        before = result[-1] if result else ""
        if line and not indent:
            section = bool(SECTION.match(line))
            literal = False
        starts_block = line and indent and not before and not section and not literal
        if starts_block and not _last_text(result).startswith((" ", "- ")):
            result += ["::", ""]
            literal = True
        starts_list = line.startswith("- ") and before and not before.startswith(("- ", "  "))
        if starts_list:
            result.append("")
        result.append(line if literal else TOKEN.sub(_token, line))
    return result


def _last_text(lines: list[str]) -> str:
    return next((line for line in reversed(lines) if line), "")


def _token(match: re.Match[str]) -> str:
    if match["code"]:
        code = match["code"].strip("`")
        return f":py:obj:`{code}`" if NAME.fullmatch(code) else f"``{code}``"
    if match["label"]:
        return f":eq:`{match['label']}`"
    return "\\" + match["mark"]


def process(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    lines[:] = restructured(lines)


def setup(app: Sphinx) -> dict[str, bool]:
    # Napoleon listens with priority 500: it is to see what this leaves.
    app.connect("autodoc-process-docstring", process, priority=400)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
