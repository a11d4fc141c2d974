"""What is to be shown of a run at one instant, worked out from what lies in shared memory."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from adapter.control.feedforward import ModelFeedforward, not_learned
from adapter.effects.active import with_bodies
from adapter.model.self_model import SelfModel
from adapter.model.spatial import Array
from adapter.model.tree import Tree
from adapter.physics.identifiability import SHOWN_ALONE, base_parameters, frame_observability
from adapter.realtime.run_messages import nearest_frames
from adapter.realtime.showing import View
from adapter.realtime.snapshot import Snapshot
from adapter.realtime.timing import LoopTiming
from adapter.signals.records import StateLayout, stamp_of

ABOVE_NOISE = 2.0  # times the noise, beyond which a residual is said to be more
WAITING, LEARNING, CONVERGED = "waiting", "learning", "converged"


@dataclass(frozen=True)
class KnownRun:
    """What is known of a run before it begins.

    Attributes:
        documented: the arm, its tool included.
        effects: learned beside θ, in the order of the snapshot.
        driver: address of the arm.
        duration_s: planned; None for no end.
        key: of this run, so that a page knows one run from the next.
    """

    documented: SelfModel
    effects: tuple[str, ...]
    driver: str = ""
    duration_s: float | None = None
    key: str = ""


@dataclass(frozen=True)
class LearnedFrames:
    """λ against the documentation, of all frames that move as the learned ones do the nearest.

    Attributes:
        R, p: (n, 3, 3), (n, 3) in the parents' axes, rad and m.
        off, off_std: (n, 6) [turn; shift] from the documented frames, rad and m, and standard
            deviations; hidden: (n, 6) bool, what no motion shows, which is the documentation's.
    """

    R: Array
    p: Array
    off: Array
    off_std: Array
    hidden: np.ndarray


@dataclass(frozen=True)
class Now:
    """A run at one instant; n joints.

    Attributes:
        view: what was seen.
        stamp_ns: of the newest that is shown, on the arm's clock; t_s: since the run's first one.
        q, dq, tau: (n,) of the newest filtered state; NaN before the first.
        residual: (n,) N m, measured torque less that of the estimate; NaN before θ is learned.
        rms: (n,) N m of it over the last second; noise: (n,) what the estimate leaves unexplained
            of all torques that it was learned from.
        frames: λ against the documentation; None before there is any.
        lam_state, theta_state: `WAITING`, `LEARNING` or `CONVERGED`.
        load: what was picked up: "m", "m_std" (kg), "since_s" on the run's clock; None for nothing.
        findings: of the monitor, times on the run's clock.
        joint_states: a word or two on each joint.
        headline: the state of the run in one sentence.
        lately: timing of the last seconds; None before there is any.
    """

    view: View
    stamp_ns: int
    t_s: float
    q: Array
    dq: Array
    tau: Array
    residual: Array
    rms: Array
    noise: Array
    frames: LearnedFrames | None
    lam_state: str
    theta_state: str
    load: dict[str, Any] | None
    findings: list[dict[str, Any]]
    joint_states: list[str]
    headline: str
    lately: LoopTiming | None

    @property
    def contact(self) -> int | None:
        """Joint (from 0) that something pushes."""
        return None if self.view.push is None else self.view.push.contact_joint


class Residual:
    """Measured torque less that of the estimate, state by state.

    Args:
        known: the run.
    """

    def __init__(self, known: KnownRun) -> None:
        arm = known.documented
        self._layout, n = StateLayout(arm.tree.n), arm.tree.n
        lasting = not_learned(arm, known.effects)
        self._model = ModelFeedforward(arm.tree, with_bodies(arm).gravity, known.effects, lasting)
        self._tool = np.zeros((n, 10)) if arm.tool is None else arm.theta_with_tool() - arm.theta
        self._version, self._ready = 0, False
        self._last, self._power, self._stamp_ns = np.full(n, np.nan), np.full(n, np.nan), 0

    def follow(self, snapshot: Snapshot) -> None:
        """Go on with an estimate, once θ is being learned."""
        if snapshot.version == self._version:
            return
        self._version = snapshot.version
        if np.isfinite(snapshot.lam).all() and np.isfinite(snapshot.theta).all():
            effects = np.nan_to_num(snapshot.effects)
            self._model.set(
                snapshot.lam, snapshot.theta + self._tool, effects, snapshot.effect_shapes
            )
            self._ready = True

    def take(self, records: Array) -> tuple[Array, Array]:
        """Newest residual (n,) and its rms over the last second, N m, after these states (m, size);
        NaN before anything is known."""
        if self._ready and len(records):
            at = self._layout
            for k in np.unique(np.linspace(0, len(records) - 1, 8).astype(int)):
                row = records[k]
                self._last = row[at.joint_tau] - self._model(row[at.q], row[at.dq], row[at.ddq])
                since_s = 1e-9 * (stamp_of(row) - self._stamp_ns)
                keep = math.exp(-since_s / 1.0) if since_s > 0.0 else 0.0
                self._stamp_ns = stamp_of(row)
                before = np.where(np.isfinite(self._power), self._power, self._last**2)
                self._power = keep * before + (1.0 - keep) * self._last**2
        return self._last, np.sqrt(self._power)


class Onlooker:
    """Works out what is to be shown, look after look.

    Args:
        known: the run.
    """

    def __init__(self, known: KnownRun) -> None:
        self.known, n = known, known.documented.tree.n
        self._layout, self._residual = StateLayout(n), Residual(known)
        self._last = np.full((3, n), np.nan)
        self._stamp_ns = 0
        self._frames: LearnedFrames | None = None
        self._frames_of = 0
        self._timings: deque[tuple[float, LoopTiming]] = deque()
        self._late: LoopTiming | None = None

    def look(self, view: View) -> Now:
        """What is to be shown of it."""
        at, snapshot, news = self._layout, view.snapshot, view.news
        if len(view.records):
            newest = view.records[-1]
            self._last = np.array([newest[at.q], newest[at.dq], newest[at.joint_tau]])
            self._stamp_ns = stamp_of(newest)
        learning, n = bool(news.get("theta_started")), len(self._last[0])
        noise = np.full(n, np.nan)
        if snapshot is not None and learning:
            self._residual.follow(snapshot)
            noise = snapshot.torque_std
        residual, rms = self._residual.take(view.records)
        lam, theta = states_of(view, learning)
        findings = [self._on_run_clock(found, view) for found in news.get("findings", [])]
        load = news.get("load")
        stamp_ns = max(self._stamp_ns, 0 if view.push is None else view.push.stamp_ns)
        q, dq, tau = self._last
        return Now(
            view=view,
            stamp_ns=stamp_ns,
            t_s=1e-9 * (stamp_ns - view.began_ns) if stamp_ns and view.began_ns else 0.0,
            q=q,
            dq=dq,
            tau=tau,
            residual=residual,
            rms=rms,
            noise=noise,
            frames=self._learned_frames(snapshot),
            lam_state=lam,
            theta_state=theta,
            load=None if load is None else self._on_run_clock(load, view),
            findings=findings,
            joint_states=joint_words(view, findings, (rms, noise), theta),
            headline=headline(view, (lam, theta), self.known.documented.tree),
            lately=self._lately(view),
        )

    def _on_run_clock(self, told: dict[str, Any], view: View) -> dict[str, Any]:
        times = ("since_s", "reported_s", "over_s")
        begin_s = 1e-9 * view.began_ns
        return {k: v - begin_s if k in times and v is not None else v for k, v in told.items()}

    def _lately(self, view: View) -> LoopTiming | None:
        timing, past = view.timing, self._timings
        if timing is None:
            return None
        if past and past[-1][1] is timing:
            return self._late
        past.append((view.elapsed_s, timing))
        while len(past) > 2 and view.elapsed_s - past[1][0] > 5.0:
            past.popleft()
        self._late = timing.since(past[0][1]) if len(past) > 1 else timing
        return self._late

    def _learned_frames(self, snapshot: Snapshot | None) -> LearnedFrames | None:
        """Looked at anew a few times a second: it takes milliseconds."""
        if snapshot is None or not snapshot.version or not np.isfinite(snapshot.lam).all():
            return self._frames
        if snapshot.learned >= self._frames_of:
            documented, lam = self.known.documented, snapshot.lam
            seen = frame_observability(documented.tree, lam, documented.gravity)
            found = nearest_frames(seen.freedom, lam, documented.lam)
            self._frames = LearnedFrames(*found, snapshot.lam_std, ~seen.flags)
            self._frames_of = snapshot.learned + 1000  # states; they take milliseconds
        return self._frames

    @cached_property
    def shown_alone(self) -> np.ndarray:
        """(n, 10) bool: parameters of θ that torques show without those of other links."""
        arm = self.known.documented
        basis = base_parameters(arm.tree, arm.lam, arm.gravity).basis
        return np.einsum("ab,ab->a", basis, basis).reshape(-1, 10) > SHOWN_ALONE


def untold(findings: list[dict[str, Any]], told: set[str]) -> Iterator[dict[str, Any]]:
    """Findings that were not told yet, nor so: how long they last is news; `told` grows."""
    for found in findings:
        key = f"{found['what']} {found['joints']} {found['since_s']:.3f} {found['over_s']}"
        if key not in told:
            told.add(key)
            yield found


def states_of(view: View, learning: bool) -> tuple[str, str]:
    """How far λ and θ are."""
    snapshot = view.snapshot
    if snapshot is None or not snapshot.learned:
        return WAITING, WAITING
    lam = CONVERGED if snapshot.lam_converged else LEARNING
    if not learning:
        return lam, WAITING
    return lam, CONVERGED if snapshot.theta_converged else LEARNING


def joint_words(
    view: View, findings: list[dict[str, Any]], sizes: tuple[Array, Array], theta: str
) -> list[str]:
    """A word or two on each joint: what is wrong there, or that nothing is.

    Args:
        sizes: (n,) rms of the residual, and what is usual of it, N m; theta: its state.
    """
    learning = "learning, " if theta == LEARNING else ""
    words = []
    for j, (size, usual) in enumerate(zip(*sizes, strict=True)):
        active = [f["what"] for f in findings if f["over_s"] is None and j + 1 in f["joints"]]
        if view.push is not None and view.push.contact_joint == j:
            words.append("contact")
        elif active:
            words.append(str(active[-1]).replace("_", " "))
        elif not (math.isfinite(size) and math.isfinite(usual) and usual > 0.0):
            words.append("not learned yet")
        elif size > ABOVE_NOISE * usual:
            words.append(f"{learning}{size / usual:.2g} times the noise")
        else:
            words.append("as expected")
    return words


ENDED = {
    "duration": "the planned time is over",
    "interrupted": "somebody stopped it",
    "operator_gone": "the operator's terminal was closed",
    "driver_error": "the arm or its driver failed",
    "end_of_stream": "the source has no more samples",
}


def headline(view: View, states: tuple[str, str], tree: Tree) -> str:
    """The state of the run in one sentence."""
    if view.ended is not None:
        why, fault = view.ended
        sentence = f"Ended: {fault or ENDED.get(why, why)}"
        return sentence if view.done else f"{sentence}; the learner takes in what is left"
    if view.done:
        return "Ended"
    if view.push is not None and view.push.contact_joint is not None:
        return f"Contact: something pushes {tree.joint_names[view.push.contact_joint]}"
    if view.news.get("refusal"):
        return "The torques are not those of this arm: nothing is called converged"
    late = f"; the learner is {view.waiting} samples behind" if view.waiting > 1000 else ""
    lam, theta = states
    if lam == WAITING:
        return f"Waiting for the first motion{late}"
    if lam == LEARNING:
        return f"Learning where the joints sit (λ){late}"
    if theta == CONVERGED:
        return f"Learned: λ and θ have converged{late}"
    return f"Learning what the links weigh (θ); λ has converged{late}"
