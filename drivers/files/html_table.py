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
    lines = [_row("th", heads), *(_row("td", row) for row in rows)]
    table = f"<table>{''.join(lines)}</table>" if rows else ""
    return f"<p><b>{escape(title)}</b></p>{table}"


def _row(kind: str, cells: Sequence[str]) -> str:
    return f"<tr>{''.join(f'<{kind}>{escape(cell)}</{kind}>' for cell in cells)}</tr>"
