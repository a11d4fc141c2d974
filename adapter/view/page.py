"""The live page, and what it is told as JSON: who the arm is, and again and again where it stands.

    hello     names, units, the documented model: once for each page
    history   rows of the residuals of the last seconds and of the estimate of the whole run
    frame     some 20 times a second: residuals, push, skeleton, state
    estimate  twice a second: λ and θ with standard deviations
    news      where it changed: findings, load, lines
    timing    twice a second

Each message is whole in itself, so that one that a slow page never gets is no loss.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import socket
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from markupsafe import Markup

from adapter.effects.base import with_squares
from adapter.effects.catalogue import CATALOGUE, effects_by_name
from adapter.model.inertia import PARAMETERS, UNITS
from adapter.model.spatial import Array, matrix_from_zxz
from adapter.realtime.showing import View
from adapter.report.html import fill
from adapter.report.skeleton import Skeleton, skeleton_of
from adapter.runs.terminal import json_ready
from adapter.view.foxglove_view import FoxgloveView
from adapter.view.now import KnownRun, Now, Onlooker
from adapter.view.server import ViewServer

PERIOD_S = 0.05  # between two frames
DIGITS, FINE_DIGITS = 4, 6  # significant, of what moves and of what is estimated
ESTIMATE_S = 0.5
FAST_ROWS, SLOW_ROWS = 400, 240  # kept of the past, for a page that comes late or comes back
FIRST_S = 0.25  # between two of the slow rows, at first
Message = dict[str, Any]


def numbers(values: Array | float, digits: int = DIGITS) -> Any:
    """As lists of plain numbers with so many digits; what is not finite becomes None."""
    return _rounded(np.asarray(values, dtype=np.float64).tolist(), f".{digits}g")


def _rounded(x: list[Any] | float, shape: str) -> Any:
    """Number by number: of so few at a time numpy would take ten times as long."""
    if isinstance(x, list):
        return [_rounded(part, shape) for part in x]
    return float(format(x, shape)) if math.isfinite(x) else None


def encode(message: Mapping[str, Any]) -> bytes:
    """As JSON, on one line."""
    return json.dumps(message, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()


class Messages:
    """Makes the messages of a run, look after look.

    Args:
        onlooker: of the run.
    """

    def __init__(self, onlooker: Onlooker) -> None:
        self._onlooker, self._known = onlooker, onlooker.known
        self._documented = self._known.documented
        self._recent = deque[bytes](maxlen=FAST_ROWS)
        self._whole = Whole()
        self._estimate_at = -np.inf
        self._said: Message = {}
        self._timing: Any = None

    def hello(self) -> Message:
        """Who the arm is."""
        known, arm = self._known, self._documented
        return {
            "key": known.key,
            "robot": arm.name,
            "driver": known.driver,
            "duration_s": known.duration_s,
            "joints": list(arm.tree.joint_names),
            "links": list(arm.tree.link_names),
            "parents": list(arm.tree.parent),
            "lambda": [
                *([f"turn about {axis}", "mrad"] for axis in "xyz"),
                *([f"shift along {axis}", "mm"] for axis in "xyz"),
            ],
            "theta": [list(entry) for entry in zip(PARAMETERS, UNITS, strict=True)],
            "theta_documented": numbers(arm.theta),
            "theta_alone": self._onlooker.shown_alone.tolist(),
            "effects": [
                [effect.title, with_squares(effect.units()[effect.key])]
                for effect in effects_by_name(known.effects)
            ],
            # how far the arm reaches at most: for the scale of its picture
            "reach_m": float(max(np.linalg.norm(arm.lam[:, 3:], axis=1).sum(), 1e-3)),
        }

    def history(self) -> bytes:
        """What was shown before, encoded."""
        parts = b",".join(self._recent), b",".join(self._whole.rows)
        return b'{"frames":[%s],"estimates":[%s]}' % parts

    def take(self, now: Now) -> dict[str, Message]:
        """Messages that are due, by their kind."""
        due = {"frame": self._frame(now)}
        self._recent.append(encode({key: due["frame"][key] for key in ("t", "residual", "noise")}))
        final, elapsed_s = now.view.done, now.view.elapsed_s
        if now.frames is not None and (final or elapsed_s >= self._estimate_at):
            self._estimate_at = elapsed_s + ESTIMATE_S
            due["estimate"] = self._estimate(now)
            self._whole.add(now.t_s, encode(due["estimate"]))
        told = now.view.news
        news = json_ready(
            {
                "findings": [_finding(found) for found in now.findings],
                "load": now.load,
                "notes": told.get("notes", []),
                "refused": told.get("refused", 0),
                "lines": now.view.lines,
            }
        )
        if news != self._said:
            due["news"] = self._said = news
        if now.lately is not None and (final or now.view.timing is not self._timing):
            self._timing = now.view.timing
            due["timing"] = self._times(now)
        return due

    def _frame(self, now: Now) -> Message:
        view, push = now.view, now.view.push
        shown = {"push": "torque", "push_std": "torque_std"}
        shown |= {key: key for key in ("wrench", "wrench_std")}
        return {
            "t": round(now.t_s, 3),
            "headline": now.headline,
            "done": view.done,
            "ended": None if view.ended is None else list(view.ended),
            "lam": now.lam_state,
            "theta": now.theta_state,
            "samples": view.samples,
            "waiting": view.waiting,
            "learned": 0 if view.snapshot is None else view.snapshot.learned,
            **{key: numbers(getattr(now, key)) for key in ("q", "tau", "residual", "rms", "noise")},
            "words": now.joint_states,
            "contact": now.contact,
            **{key: push and numbers(getattr(push, x)) for key, x in shown.items()},
            "push_learned": push is not None and push.learned,
            "arms": self._arms(now),
        }

    def _arms(self, now: Now) -> dict[str, Any]:
        """Skeletons, documented and learned; none before anything is known."""
        arm = self._documented
        if not np.isfinite(now.q).all():
            return {}
        placed = {"documented": (matrix_from_zxz(arm.lam[:, :3]), arm.lam[:, 3:])}
        if now.frames is not None:
            placed["learned"] = now.frames.R, now.frames.p
        both = {k: skeleton_of(arm.tree, *x, now.q, arm.frames) for k, x in placed.items()}
        return {name: _points(skeleton) for name, skeleton in both.items()}

    def _estimate(self, now: Now) -> Message:
        snapshot, frames = now.view.snapshot, now.frames
        assert snapshot is not None and frames is not None
        known = now.theta_state != "waiting"
        unknown = np.full_like(snapshot.theta, np.nan)
        return {
            "t": round(now.t_s, 2),
            "off": numbers(1e3 * frames.off, FINE_DIGITS),
            "off_std": numbers(1e3 * frames.off_std, FINE_DIGITS),
            "hidden": frames.hidden.tolist(),
            "theta": numbers(snapshot.theta if known else unknown, FINE_DIGITS),
            "theta_std": numbers(snapshot.theta_std if known else unknown, FINE_DIGITS),
            "effects": numbers(snapshot.effects, FINE_DIGITS),
            "effects_std": numbers(snapshot.effects_std, FINE_DIGITS),
        }

    def _times(self, now: Now) -> Message:
        timing, lately = now.view.timing, now.lately
        assert timing is not None and lately is not None
        told: Message = {"missed": timing.missed, "missed_own": timing.missed_own}
        told["missed_lately"] = lately.missed
        for what in ("loop_us", "lateness_us"):
            whole, late = timing.of(what), lately.of(what)
            told[what] = {
                "count": whole.count,
                "p50": whole.percentile_us(50.0),
                "p99": whole.percentile_us(99.0),
                "max": 1e-3 * whole.max_ns,
                "p50_lately": late.percentile_us(50.0),
                "p99_lately": late.percentile_us(99.0),
            }
        return json_ready(told)


def _finding(found: Mapping[str, Any]) -> Message:
    """One of the monitor's, with names and units for people."""
    effect = CATALOGUE.get(found["what"])
    units = {} if effect is None else effect.units()
    size = {} if effect is None else {k: v for k, v in found["size"].items() if k in units}
    return {
        "title": found["what"] if effect is None else effect.title,
        "size": [[key, numbers(value), with_squares(units[key])] for key, value in size.items()],
        "or": [rival["what"].replace("_", " ") for rival in found["ambiguous_with"]],
        **{key: found[key] for key in ("joints", "since_s", "reported_s", "over_s")},
    }


def _points(arm: Skeleton) -> Message:
    places: dict[str, Any] = {"joints": arm.p, "axes": arm.axis, "tips": list(arm.tips.values())}
    return {k: np.round(x, 4).tolist() for k, x in places.items()} | {"tip_of": list(arm.tips)}


class Whole:
    """Rows over the whole run, at ever longer distances in time, encoded, oldest first.

    Where they get more than `SLOW_ROWS`, every other one goes.
    """

    def __init__(self) -> None:
        self.rows: list[bytes] = []
        self._every_s, self._due_s = FIRST_S, -math.inf

    def add(self, t_s: float, row: bytes) -> None:
        """Keep the row of this time if it is due."""
        if t_s < self._due_s:
            return
        self.rows.append(row)
        if len(self.rows) >= SLOW_ROWS:
            del self.rows[1::2]
            self._every_s *= 2.0
        self._due_s = t_s + self._every_s


def page_of(known: KnownRun) -> tuple[str, str]:
    """HTML of the page and its Content-Security-Policy: nothing from elsewhere, no other script."""
    script = fill("live.js", {}, __package__)
    context = {"robot": known.documented.name, "script": Markup(script)}
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; "
        "connect-src 'self'; img-src data:; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    )
    return fill("live.html", context, __package__), policy


class LivePage:
    """Serves the page and feeds it.

    Args:
        onlooker: of the run.
        listening: where it is served.
    """

    def __init__(self, onlooker: Onlooker, listening: socket.socket) -> None:
        self._messages = Messages(onlooker)
        self._server = ViewServer(listening, *page_of(onlooker.known))
        self._server.newest.put({"hello": encode(self._messages.hello())})
        self._server.start()
        self._frames = 0

    def __call__(self, now: Now) -> None:
        """Take what is to be seen now; waits for nobody."""
        due = {kind: encode(message) for kind, message in self._messages.take(now).items()}
        if now.view.done or self._frames % 20 == 0:  # for pages that come
            due["history"] = self._messages.history()
        self._frames += 1
        self._server.newest.put(due)
        if now.view.done:
            self._server.stop()


def make_view(
    known: KnownRun, listening: socket.socket | None, foxglove_port: int | None
) -> Callable[[View], None]:
    """What the view process shows: the page, Foxglove's protocol, or both."""
    onlooker, shows = Onlooker(known), list[Callable[[Now], None]]()
    if listening is not None:
        shows.append(LivePage(onlooker, listening))
    if foxglove_port is not None:
        shows.append(FoxgloveView(known, foxglove_port))

    def show(view: View) -> None:
        now = onlooker.look(view)
        for one in shows:
            one(now)

    return show
