"""A short HTML table: how notebooks show logs, models and results."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

NOTHING = "–"


def html_table(title: str, heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table under a title; all text is escaped.

    >>> html_table("a < b", ["joint"], [["1"]])
    '<p><b>a &lt; b</b></p><table><tr><th>joint</th></tr><tr><td>1</td></tr></table>'
    """
    kinds = zip(("th", *("td" for _ in rows)), (heads, *rows), strict=True)
    lines = ("".join(f"<{kind}>{escape(x)}</{kind}>" for x in cells) for kind, cells in kinds)
    table = "".join(f"<tr>{line}</tr>" for line in lines)
    return f"<p><b>{escape(title)}</b></p>" + (f"<table>{table}</table>" if rows else "")
