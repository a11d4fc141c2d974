"""Numbers for people: so many digits, and no more of them than their doubt leaves."""

from __future__ import annotations

import math
from typing import Any

DASH = "–"
MOST_DIGITS = 5  # of a value, however small its standard deviation


def plain(value: Any, digits: int = 3) -> str:
    """A number with that many significant digits and no exponent; a dash where there is none.

    >>> plain(0.012345), plain(12345.6), plain(None), plain(-2.0)
    ('0.0123', '12346', '–', '-2.00')
    """
    if value is None or not math.isfinite(value):
        return DASH
    if abs(value) < 1e-9:
        return "0"
    return f"{value:.{max(0, digits - 1 - _order(value))}f}"


def plus_minus(value: Any, std: Any = None) -> str:
    """Value ± standard deviation, both to the second digit of the latter.

    >>> plus_minus(2.0, 0.03), plus_minus(12345.0, 340.0), plus_minus(1.5), plus_minus(-1e-9, 0.01)
    ('2.000 ± 0.030', '12340 ± 340', '1.50', '0.000 ± 0.010')
    """
    known = value is not None and math.isfinite(value)
    if not known or std is None or not math.isfinite(std) or std == 0.0:
        return plain(value)
    decimals = 1 - _order(std)
    if value and decimals > MOST_DIGITS - 1 - _order(value):
        return plain(value, MOST_DIGITS)
    shown, doubt = round(value, decimals) + 0.0, round(std, decimals)  # no minus before 0.00
    return f"{shown:.{max(decimals, 0)}f} ± {doubt:.{max(decimals, 0)}f}"


def _order(value: float) -> int:
    return math.floor(math.log10(abs(value)))
