"""How figures look: small SVG panels whose colours are the page's, light or dark.

A panel is drawn with stand-in colours; on the way out each becomes a CSS variable, text stays
text, coordinates are rounded, and nothing that refers to the outside is left in.
"""

from __future__ import annotations

import io
import itertools
import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup, escape

from adapter.model.spatial import Array

if TYPE_CHECKING:  # loaded where a panel is drawn: takes long, and not every run has a page
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.figure import Figure
    from matplotlib.ticker import Locator

JOINT_COLORS = 8  # the page defines --j1 to --j8; more joints go round again
_NAMES = ("ink", "muted", "grid", "accent", "goal", *(f"j{k + 1}" for k in range(JOINT_COLORS)))
STAND_IN = {name: f"#0a0b{k + 16:02x}" for k, name in enumerate(_NAMES)}
INK, MUTED, GRID = STAND_IN["ink"], STAND_IN["muted"], STAND_IN["grid"]
ACCENT, GOAL = STAND_IN["accent"], STAND_IN["goal"]

# width, height in inches and text in points: two, three or four panels side by side
SIZES = {"half": (5.4, 2.55, 7.8), "third": (3.7, 2.35, 7.6), "quarter": (2.9, 2.0, 7.8)}
SUPERFLUOUS = (  # what the page's style says, and what shows nothing
    r" font-family: [^;\"]*;",
    r"; stroke-line(cap: square|join: \w+)",
    r' transform="rotate\(-?0 [^"]*"',
    r'<path d="[^"]*" style="fill: none"/>',
)
NAMED = "line named "
MOST_POINTS = 500  # along one line; a panel has no more pixels
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Panel:
    """A figure of the page: title and unit above, a note below."""

    title: str
    unit: str
    svg: Markup
    size: str
    note: str = ""


def joint_color(j: int) -> str:
    """Stand-in of the colour of joint j (from 0)."""
    return STAND_IN[f"j{j % JOINT_COLORS + 1}"]


class Drawing:
    """A panel being drawn.

    Args:
        size: one of `SIZES`.
        rows: relative heights of axes above each other, sharing their x.
        bare: without axes' frame, ticks and grid, and with equal scales.
        stretch: times the usual height.
    """

    _numbers = itertools.count(1)

    def __init__(
        self, size: str, rows: Sequence[float] = (1.0,), bare: bool = False, stretch: float = 1.0
    ) -> None:
        from matplotlib import rc_context
        from matplotlib.backends.backend_svg import FigureCanvasSVG
        from matplotlib.figure import Figure

        width, height, text = SIZES[size]
        self.size = size
        self.named_x = False  # names along x, no numbers
        self.figure = Figure(figsize=(width, height * stretch))
        FigureCanvasSVG(self.figure)
        with rc_context({"font.size": text, "axes.linewidth": 0.6}):
            axes = self.figure.subplots(len(rows), 1, sharex=True, height_ratios=rows)
            self.axes: list[Axes] = list(np.ravel(axes))
        left, foot = 3.4 * text / 72 / width, 3.1 * text / 72 / (height * stretch)
        if bare:
            self.figure.subplots_adjust(0.02, 0.02, 0.98, 0.98)
        else:
            top = 1.0 - 0.06 / stretch
            self.figure.subplots_adjust(left + 0.02, foot, 0.985, top, hspace=0.14)
        for ax in self.axes:
            _dress(ax, text, bare)

    def panel(self, title: str, unit: str = "", note: str = "") -> Panel:
        """Done: the SVG and its words."""
        label = f"{title}, {unit}" if unit else title
        told = f' aria-label="{escape(label)}"{self._scales(unit)}'
        return Panel(title, unit, _svg(self.figure, told, self.size), self.size, note)

    def _scales(self, unit: str) -> str:
        """Attributes from which the page's script tells what is under the pointer; none where the
        axes have no scales."""
        boxes = [_scale(ax, self.figure, unit) for ax in self.axes if ax.axison]
        if not boxes:
            return ""
        x = self.axes[-1].get_xlabel()
        given = f' data-x="{escape(x)}"' if x and not self.named_x else ""
        return f' data-axes="{escape(json.dumps(boxes, separators=(",", ":")))}"{given}'


def _scale(ax: Axes, figure: Figure, unit: str) -> list[Any]:
    """Where axes lie and what they show: [left, top, right, bottom, x from, x to, y from, y to,
    x and y logarithmic, unit of y], the first four in the drawing's own units."""
    width, height = 72.0 * figure.get_size_inches()
    at = ax.get_position()
    edges = at.x0 * width, (1 - at.y1) * height, at.x1 * width, (1 - at.y0) * height
    numbers = [float(f"{x:.4g}") for x in (*edges, *ax.get_xlim(), *ax.get_ylim())]
    logarithmic = [int(scale == "log") for scale in (ax.get_xscale(), ax.get_yscale())]
    return [*numbers, *logarithmic, ax.get_ylabel() or unit]


def named(name: str) -> str:
    """A line's `gid` by which the page tells its name under the pointer."""
    return f"{NAMED}{name}"


def _dress(ax: Axes, text: float, bare: bool) -> None:
    from matplotlib.ticker import MaxNLocator

    ax.set_facecolor("none")
    if bare:
        ax.set_axis_off()
        ax.set_aspect("equal", adjustable="datalim")
        return
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color(MUTED)
        ax.spines[side].set_linewidth(0.6)
    ax.tick_params(colors=MUTED, length=2.5, width=0.6, labelsize=text, pad=2)
    ax.grid(True, color=GRID, linewidth=0.6)
    ax.set_axisbelow(True)
    ax.margins(x=0.01)
    ax.yaxis.set_major_locator(MaxNLocator(5))
    ax.xaxis.set_major_locator(MaxNLocator(6))


def time_axis(drawing: Drawing, label: str = "time after the first motion, s") -> None:
    """Name the x axis of the lowest axes."""
    ax = drawing.axes[-1]
    ax.set_xlabel(label, color=MUTED, labelpad=1.5, fontsize=SIZES[drawing.size][2])


def log_ticks(axis: Axis, locator: Locator, words: Callable[[float], str]) -> None:
    """Ticks of a logarithmic axis and what stands at them; no smaller ones."""
    from matplotlib.ticker import FuncFormatter, NullLocator

    axis.set_major_locator(locator)
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: words(value)))


def log_axis(ax: Axes, low: float, high: float) -> None:
    """A logarithmic y axis with powers of ten written out."""
    from matplotlib.ticker import LogLocator

    ax.set_yscale("log")
    ax.set_ylim(low, high)
    log_ticks(ax.yaxis, LogLocator(10, numticks=7), power_of_ten)


def log_time(ax: Axes, first_s: float, last_s: float) -> None:
    """A logarithmic time axis from `first_s` to `last_s`."""
    from matplotlib.ticker import LogLocator

    ax.set_xscale("log")
    ax.set_xlim(first_s, max(last_s, 2 * first_s))
    log_ticks(ax.xaxis, LogLocator(10, subs=(1.0, 2.0, 5.0), numticks=12), "{:g}".format)


def legend(ax: Axes, **how: Any) -> None:
    """Names of the lines, without a frame; more as matplotlib's."""
    ax.legend(**{"frameon": False, "labelcolor": MUTED, "fontsize": SIZES["third"][2], **how})


def categories(ax: Axes, names: Sequence[str]) -> None:
    """Names along x, at 0, 1, 2, ..."""
    ax.set_xlim(-0.6, len(names) - 0.4)
    ax.set_xticks(range(len(names)), [str(name) for name in names], parse_math=False)
    ax.grid(False, axis="x")


def power_of_ten(value: float) -> str:
    """10⁻³ below 0.001 and from 10 000 up, the plain number between."""
    if 0.99e-3 <= value < 1e4:
        return f"{value:g}"
    return "10" + str(round(float(np.log10(value)))).translate(SUPERSCRIPTS)


def mark(ax: Axes, x: float | None, text: str, top: float = 0.98) -> None:
    """A vertical line in time with words at its top, or lower (as a share of the height); none
    where the time is unknown or not shown."""
    low, high = ax.get_xlim()
    if x is None or not low <= x <= high:
        return
    ax.axvline(x, color=MUTED, linewidth=0.9, linestyle=(0, (4, 2)))
    share = ax.transAxes.inverted().transform(ax.transData.transform((x, ax.get_ylim()[1])))[0]
    side, away = ("right", -3) if share > 0.7 else ("left", 3)
    coords = ("data", "axes fraction")
    _say(ax, text, (x, top), MUTED, xycoords=coords, xytext=(away, 0), ha=side, va="top")


def level(ax: Axes, y: float, text: str, left: bool) -> None:
    """A horizontal goal line with its words at the left or the right end."""
    ax.axhline(y, color=GOAL, linewidth=0.9, linestyle=(0, (4, 2)))
    x, side, away = (0.0, "left", 3) if left else (1.0, "right", -2)
    coords = ("axes fraction", "data")
    _say(ax, text, (x, y), GOAL, xycoords=coords, xytext=(away, 2), ha=side, va="bottom")


def _say(ax: Axes, text: str, at: tuple[float, float], color: str, **how: Any) -> None:
    """Words beside a place, as matplotlib's `annotate` has it."""
    size = SIZES["third"][2]
    ax.annotate(text, at, textcoords="offset points", color=color, fontsize=size, **how)


def thin(t: Array, y: Array, most: int = MOST_POINTS) -> tuple[Array, Array]:
    """A line with at most about `most` points that keeps every peak: lowest and highest of each
    stretch, in their order."""
    if len(t) <= most:
        return t, y
    edges = np.linspace(0, len(t), most // 2 + 1).astype(int)
    keep: list[int] = []
    for start, stop in itertools.pairwise(edges):
        part = y[start:stop]
        if np.isfinite(part).any():
            keep.extend(sorted({start + int(np.nanargmin(part)), start + int(np.nanargmax(part))}))
    return t[keep], y[keep]


def thin_rows(t: Array, rows: Array, most: int = MOST_POINTS) -> tuple[Array, Array]:
    """Rows (k, ...) over time with at most about `most` of them, the last one kept."""
    if len(t) <= most:
        return t, rows
    keep = np.linspace(0, len(t) - 1, most).astype(int)
    return t[keep], rows[keep]


def _svg(figure: Figure, told: str, size: str) -> Markup:
    """The figure as inline SVG in the page's colours, without any reference to the outside.

    `told`: more attributes of it, as markup.
    """
    from matplotlib import rc_context

    buffer = io.StringIO()
    names = ("Date", "Creator", "Format", "Type")
    with rc_context({"svg.fonttype": "none", "svg.hashsalt": "panda-adapter"}):
        figure.savefig(buffer, format="svg", transparent=True, metadata=dict.fromkeys(names))
    text = buffer.getvalue()
    box = re.search(r'viewBox="([^"]+)"', text)
    assert box is not None
    body = text[text.index(">", text.index("<svg")) + 1 : text.rindex("</svg>")]
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.S)
    body = re.sub(r"<style.*?</style>", "", body, flags=re.S)
    body = body.replace("xlink:href", "href")
    body = re.sub(rf'<g id="{NAMED}([^"]*)">', r"<g><title>\1</title>", body)
    # ids that are referred to get a prefix, so that they are the page's only ones; the rest go
    prefix = f"f{next(Drawing._numbers)}-"
    for name in set(re.findall(r"[\"(]#([\w.-]+)", body)):
        body = body.replace(f'id="{name}"', f"\0{prefix}{name}\0")
        body = re.sub(rf'(["(])#{re.escape(name)}(?=[")])', rf"\1#{prefix}{name}", body)
    body = re.sub("\0([^\0]*)\0", r'id="\1"', re.sub(r' id="[^"]*"', "", body))
    body = re.sub(r'\bd="[^"]*"', lambda found: _rounded(found.group(0), 1), body)
    body = re.sub(r'(?<= d=)"[ML][-\d. MLz\n]*"', lambda found: _short(found.group(0)), body)
    body = re.sub(r"<[^>]*>", lambda found: _rounded(found.group(0), 2), body)  # not the text
    for words in SUPERFLUOUS:
        body = re.sub(words, "", body)
    body = re.sub(r"\s*\n\s*", "\n", body)
    for name, color in STAND_IN.items():
        body = body.replace(color, f"var(--{name})")
    head = f'<svg class="{size}" viewBox="{box.group(1)}" role="img"{told}>'
    return Markup(f"{head}{body}</svg>")


def _short(path: str) -> str:
    """A path of straight lines in fewer characters: a line goes on without its letter."""
    return re.sub(r"(?<=\d) ?L (?=[-\d])", " ", re.sub(r"\s+", " ", path)).replace("M ", "M")


def _rounded(text: str, digits: int) -> str:
    """All numbers with more decimals than that rounded."""

    def short(found: re.Match[str]) -> str:
        shown = f"{float(found.group(0)):.{digits}f}".rstrip("0").rstrip(".")
        return "0" if shown == "-0" else shown

    return re.sub(rf"-?\d+\.\d{{{digits + 1},}}", short, text)


def lines_by_joint(ax: Axes, t: Array, values: Array) -> None:
    """One line per joint, values (k, n), in the joints' colours."""
    for j in range(values.shape[1]):
        line = thin(t, values[:, j])
        ax.plot(*line, color=joint_color(j), linewidth=1.1, gid=named(f"joint {j + 1}"))
