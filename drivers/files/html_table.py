"""A short HTML table: how notebooks show logs, models and results."""

from __future__ import annotations

import math
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


def plus_minus(value: float, std: float = math.nan) -> str:
    """A value ± its standard deviation, both to the second digit of the latter.

    >>> plus_minus(0.31234, 0.0123), plus_minus(2.5), plus_minus(-1e-9, 0.01), plus_minus(math.nan)
    ('0.312 ± 0.012', '2.5', '0.000 ± 0.010', '–')
    """
    if not math.isfinite(value):
        return NOTHING
    if not (math.isfinite(std) and std > 0.0):
        return f"{value:.3g}"
    decimals = max(0, 1 - math.floor(math.log10(std)))
    return f"{round(value, decimals) + 0.0:.{decimals}f} ± {std:.{decimals}f}"


def _row(kind: str, cells: Sequence[str]) -> str:
    return f"<tr>{''.join(f'<{kind}>{escape(cell)}</{kind}>' for cell in cells)}</tr>"
