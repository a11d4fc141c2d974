"""The table during a run, on a terminal; lives in a process of its own.

Lines that are said meanwhile come out above it.
"""

from __future__ import annotations

import math

from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from adapter.gap.monitor_judge import sentence
from adapter.model.numbers import plus_minus
from adapter.realtime.showing import View
from adapter.runs.terminal import DISAGREEMENT, console
from adapter.view.now import ABOVE_NOISE, CONVERGED, KnownRun, Now, Onlooker, untold

GOOD, LOUD, DIM = "green", "yellow", "dim"


class LiveTable:
    """A table that is drawn anew in its place, from the first sample to the loop's end.

    Args:
        known: the run.
        shown_on: a terminal; this one where None.
    """

    def __init__(self, known: KnownRun, shown_on: Console | None = None) -> None:
        self._known, self._console = known, shown_on or console
        self._onlooker = Onlooker(known)
        self._live: Live | None = None
        self._lines = 0
        self._told: set[str] = set()

    def __call__(self, view: View) -> None:
        """Draw what is to be seen now."""
        now = self._onlooker.look(view)
        over = view.done or view.ended is not None
        if self._live is None and view.samples and not over:
            self._live = Live(console=self._console, auto_refresh=False, transient=True)
            self._live.start()
        self._say(now)
        if self._live is None:
            return
        if over:
            self._live.stop()
            self._live = None
        else:
            self._live.update(table_of(now, self._known), refresh=True)

    def _say(self, now: Now) -> None:
        """What is new since the last look, above the table."""
        lines = now.view.lines[self._lines :]
        self._lines = len(now.view.lines)
        for found in untold(now.findings, self._told):
            lines.append(f"{DISAGREEMENT}: {sentence(found, 0.0)}")
        for note in now.view.news.get("notes", []):
            if note not in self._told:
                self._told.add(note)
                lines.append(f"warning: {note}")
        for line in lines:
            self._console.print(line, soft_wrap=True)


def table_of(now: Now, known: KnownRun) -> Group:
    """The run as a table: a row for each joint, what concerns all of them around it."""
    table = Table(box=SIMPLE_HEAD, padding=(0, 1), pad_edge=False)
    table.add_column("joint", no_wrap=True)
    for name in ("torque", "unexplained", "noise"):
        table.add_column(f"{name}, N m", justify="right", no_wrap=True)
    table.add_column("state", no_wrap=True)
    names = known.documented.tree.joint_names
    rows = zip(names, now.tau, now.rms, now.noise, now.joint_states, strict=True)
    for name, tau, rms, noise, state in rows:
        loud = math.isfinite(rms) and rms > ABOVE_NOISE * noise
        style = LOUD if loud else GOOD if state == "as expected" else DIM
        table.add_row(name, _number(tau, 2), _number(rms, 3), _number(noise, 3), Text(state, style))
    head = Text(now.headline, "bold", no_wrap=True, overflow="ellipsis")
    return Group(head, table, _learning(now), _progress(now, known))


def _learning(now: Now) -> Text:
    """λ, θ, load, contact."""
    text = Text(no_wrap=True, overflow="ellipsis")
    for name, state in (("λ", now.lam_state), ("θ", now.theta_state)):
        text.append(f"{name} ").append(state, GOOD if state == CONVERGED else LOUD).append(" · ")
    load = now.load
    carried = "none noticed" if load is None else f"{plus_minus(load['m'], load['m_std'])} kg"
    text.append(f"load {carried} · contact ")
    contact = "none" if now.contact is None else f"joint {now.contact + 1}"
    return text.append(contact, "" if now.contact is None else LOUD)


def _progress(now: Now, known: KnownRun) -> Text:
    """Time, samples, timing."""
    last = known.duration_s
    at_s, end = (now.t_s, "") if last is None else (min(now.t_s, last), f" of {last:g}")
    text = Text(f"{at_s:.1f}{end} s", no_wrap=True, overflow="ellipsis")
    if now.view.snapshot is not None:
        text.append(f" · {now.view.snapshot.learned} learned, {now.view.waiting} wait")
    if now.lately is not None and now.view.timing is not None:
        p99 = now.lately.of("loop_us").percentile_us(99.0)
        missed = now.view.timing.missed
        text.append(f" · tick p99 {_number(p99, 0)} µs, ")
        said = f"{missed} deadline{'' if missed == 1 else 's'} missed"
        text.append(said, LOUD if now.lately.missed else "")
    return text


def _number(value: float | None, decimals: int) -> str:
    """A dash for what is not known."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{value:.{decimals}f}".replace("-", "−")
