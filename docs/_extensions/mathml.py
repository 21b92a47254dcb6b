"""Equations as MathML, which browsers draw by themselves: a page needs no script, no font and no network to be read."""

from __future__ import annotations

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.util.math import get_node_equation_number


def inline(translator, node: nodes.math) -> None:
    """Write an equation within a line of text, and nothing else of the node."""
    translator.body.append(convert(node.astext()))
    raise nodes.SkipNode


def display(translator, node: nodes.math_block) -> None:
    """Write an equation on lines of its own, with its number and a link to it where it has a label."""
    equation = convert(node.astext(), display="block")
    translator.body.append(translator.starttag(node, "div", CLASS="math") + f"<div>{equation}</div>")
    if node["number"]:
        number = get_node_equation_number(translator, node)
        translator.body.append(f'<span class="eqno">({number})')
        translator.add_permalink_ref(node, "Link to this equation")
        translator.body.append("</span>")
    translator.body.append("</div>\n")
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_html_math_renderer("mathml", inline_renderers=(inline, None), block_renderers=(display, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
