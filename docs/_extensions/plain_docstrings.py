"""Docstrings of this project are plain text in Google's style; this turns them into what autodoc wants.

- `` `code` `` becomes a link where it names an object of the package, and code in any case.
- `Eq. (label)` becomes a link to that equation of the theory page.
- Indented blocks between paragraphs, which hold equations and layouts, stay as they are.
- `*`, `|` and a trailing `_` are letters: shapes such as (*, n), norms such as |x|.

Classes whose metaclass hides their constructor, as those of TorchRL, show its arguments all the same, and the fields of
a named tuple, which Python documents as "Alias for field number 0", stand in its signature alone. Long values of
constants are left to the source.
"""

from __future__ import annotations

import re

from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.util import inspect

SECTION = re.compile(r"(Args|Attributes|Returns|Raises|Yields|Example|Examples|Note|References):$")
TOKEN = re.compile(r"(?P<code>`[^`]+`)|Eq\. \((?P<label>\w+)\)|(?P<mark>[*|\\]|_(?!\w))")
LONGEST_VALUE = 40
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
    if what in ("attribute", "data", "property"):
        lines[:0] = ["..", ""]  # an empty comment, since napoleon takes a first line up to its colon for a type


def constructor(
    app: Sphinx, what: str, name: str, obj: object, options: object, signature: str | None, returns: str | None
) -> tuple[str, None] | None:
    if what != "class" or signature != "(*args, **kwargs)":
        return None
    arguments = inspect.signature(obj.__init__, bound_method=True)
    return inspect.stringify_signature(arguments, unqualified_typehints=True, show_return_annotation=False), None


def is_tuple_field(app: Sphinx, what: str, name: str, obj: object, skip: bool, options: object) -> bool | None:
    return True if type(obj).__name__ == "_tuplegetter" else None


def hide_long_value(app: Sphinx, domain: str, kind: str, content: addnodes.desc_content) -> None:
    for part in list(content.parent.findall(addnodes.desc_annotation)) if kind == "data" else ():
        text = part.astext().strip()
        if text.startswith("=") and len(text) > LONGEST_VALUE:
            part.parent.remove(part)


def setup(app: Sphinx) -> dict[str, bool]:
    # Napoleon listens with priority 500: it is to see what this leaves.
    app.connect("autodoc-process-docstring", process, priority=400)
    app.connect("autodoc-process-signature", constructor)
    app.connect("object-description-transform", hide_long_value)
    app.connect("autodoc-skip-member", is_tuple_field)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
