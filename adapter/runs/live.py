"""What the learner process and the recorder process are asked to do in a live run."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from adapter.gap.monitor import Monitor
from adapter.learning.checkpoint import load_checkpoint, save_checkpoint
from adapter.learning.learner import OnlineLearner, TorqueVerdict
from adapter.learning.trace import Trace
from adapter.model.self_model import LAMBDA_MEASURED, LAMBDA_REPRODUCED, SelfModel
from adapter.model.spatial import Array
from adapter.physics.identifiability import SHOWN_ALONE
from adapter.realtime.jobs import LearnerJob
from adapter.realtime.snapshot import NEWS_BYTES, Snapshot
from adapter.runs.config import PipelineSettings
from adapter.runs.outcome import Outcome, changes_at, collect, in_parents
from adapter.runs.pipeline import make_front_end, make_learner
from adapter.runs.terminal import DISAGREEMENT, json_ready, json_text
from adapter.screening.screen import SHORTEST_S, RecordingRefused, torque_verdict
from adapter.signals.bristles import LONGEST_S
from adapter.signals.records import LinkMotionKind, StateLayout, stamp_of, stamps_of
from adapter.signals.told import Told
from drivers.files.mcap import Log

KEPT_LEARNER, KEPT_MONITOR = "learner.npz", "monitor.pickle"
MOST_FINDINGS = 40  # the newest, that other processes are told of

# Of motion: the first verdict and the last. In between there is one each time the motion is twice
# as long: joints that stood at first are judged then, and a load that was picked up in the first
# seconds (its torques may look like another arm's) weighs less.
FIRST_S, LAST_S = 5.0, 40.0


class LiveScreen:
    """The screen of recordings on the states that a live learner takes; see `learner.screen`.

    Args:
        documented: the arm; where its base floats, nothing is judged and nothing refused.
        say: takes the sentence that refuses, and one where more motion takes it back.
        trusted: what speaks against the torques is said and refuses nothing.
    """

    def __init__(
        self, documented: SelfModel, say: Callable[[str], None], trusted: bool = False
    ) -> None:
        self._arm, self._say, self._told = documented, say, {"told": Told(trusted=trusted)}
        self._verdict = TorqueVerdict(judged=documented.tree.floating)
        self._at = StateLayout(documented.tree.n)
        self._states = Trace(self._at.tau.stop, stride=1, capacity=20_000)
        self._moved_s, self._last_ns, self._due_s = 0.0, 0, FIRST_S

    def __call__(self, state: Array) -> TorqueVerdict:
        """Take a filtered state (a record of `StateLayout`), in order; judge when it is time."""
        if self._due_s > LAST_S or self._arm.tree.floating:
            return self._verdict
        if self._states.due():
            self._states.keep(state[: self._at.tau.stop])
        self._moved_s += min(1e-9 * (stamp_of(state) - self._last_ns), LONGEST_S)
        self._last_ns = stamp_of(state)
        if self._moved_s >= self._due_s:
            self._due_s *= 2.0
            self.judge()
        return self._verdict

    def judge(self) -> TorqueVerdict:
        """The verdict on the states so far; where they are too few, the one before stands."""
        if self._moved_s < SHORTEST_S:
            return self._verdict
        rows, at = self._states.rows, self._at
        signals = stamps_of(rows), rows[:, at.q], rows[:, at.dq], rows[:, at.tau]
        log = Log(Path("live"), self._arm.tree.joint_names, *signals, metadata=self._told)
        _, before, notes = self._verdict
        refusal = None
        try:
            torque, lines = torque_verdict(log, self._arm)
            if torque is None:
                return self._verdict
        except RecordingRefused as refused:
            refusal = str(refused)
            lines = [f"{refusal} Until that is mended nothing is called converged."]
        if before and not refusal:
            lines = ["live: with more motion the torques are those of this arm.", *lines]
        if bool(refusal) != bool(before) or not notes:  # other numbers alone are no news
            for line in lines:
                self._say(line)
            notes = (*notes, *lines)
        self._verdict = TorqueVerdict(True, refusal, notes)
        return self._verdict


def single_thread_learner(
    documented: SelfModel,
    settings: PipelineSettings,
    resume: Path | None,
    aloud: bool = False,
    trusted: bool = False,
) -> OnlineLearner:
    """A learner in a process of its own: torch on one thread, so that runs repeat bit for bit.

    A monitor looks over its shoulder, and the screen of recordings judges the torques; `aloud`,
    they tell at once what they find. `trusted` torques are not refused.
    """
    import torch

    torch.set_num_threads(1)
    learner = make_learner(documented, settings)
    delay_s = make_front_end(documented, settings).delay_s
    tool = None if documented.tool is None else documented.tool.theta()
    labels = (DISAGREEMENT, "warning")
    found, doubt = (partial(tell, label) if aloud else keep_quiet for label in labels)
    learner.watch = Monitor(documented.tree.n, tool, delay_s, found)
    learner.screen = LiveScreen(documented, doubt, trusted)
    if resume is not None:
        load_checkpoint(learner, resume)
    return learner


def learner_job(
    documented: SelfModel,
    settings: PipelineSettings,
    checkpoint: Path | None = None,
    resume: Path | None = None,
    aloud: bool = False,
    trusted: bool = False,
) -> LearnerJob:
    """The learner process of a live run; everything in it can be pickled.

    Args:
        checkpoint: where the learner's state is kept; resume: one to go on from.
        aloud: whether new disagreements are told on standard error when they are found; where a
            display says them (`news_of`), nobody else should.
        trusted: torques that are not those of the model are learned all the same.
    """
    return LearnerJob(
        make=partial(single_thread_learner, documented, settings, resume, aloud, trusted),
        collect=collect_judged,
        publish=Publisher(),
        news=news_of,
        save=None if checkpoint is None else partial(save_unrefused, path=checkpoint),
        keep=keep_learner,
        restore=restore_learner,
        effect_names=settings.learner.effects,
    )


def collect_judged(learner: OnlineLearner) -> Outcome:
    """What there is to tell at the end, the torques judged by all the motion there was."""
    if isinstance(learner.screen, LiveScreen):
        learner.verdict = learner.screen.judge()
    return collect(learner)


def save_unrefused(learner: OnlineLearner, path: Path) -> None:
    """Keep a checkpoint, unless it holds torques of another arm. Raises OSError."""
    if learner.verdict.refusal is None:
        save_checkpoint(learner, path)


def tell(label: str, line: str) -> None:
    """A line to standard error; a table on a terminal would run into it, and says it itself."""
    with suppress(OSError):  # the terminal may be gone; the learner goes on
        sys.stderr.write(f"{label}: {line}\n")
        sys.stderr.flush()


def keep_quiet(line: str) -> None:
    """Where nobody wants to hear at once; a function with a name can travel in a file."""


def keep_learner(learner: OnlineLearner, folder: Path) -> None:
    """Leave a learner and its monitor to a successor in an empty folder. Raises OSError."""
    save_checkpoint(learner, folder / KEPT_LEARNER, sync=False)
    (folder / KEPT_MONITOR).write_bytes(pickle.dumps((learner.watch, learner.screen)))


def restore_learner(learner: OnlineLearner, folder: Path) -> None:
    """Put a fresh learner into the state that its predecessor left in this private folder."""
    load_checkpoint(learner, folder / KEPT_LEARNER)
    judges = pickle.loads((folder / KEPT_MONITOR).read_bytes())
    learner.watch, learner.screen = judges


class Publisher:
    """Makes the snapshot that other processes read; standard deviations now and then."""

    def __init__(self) -> None:
        self._calls = 0
        self._std: tuple[Any, Any, Any] | None = None

    def __call__(self, learner: OnlineLearner) -> Snapshot:
        """The estimate as it stands."""
        if self._std is None or self._calls % 50 == 0:  # it takes a millisecond
            n, schema, theta = learner.tree.n, learner.schema, learner.theta
            tables = schema.covariance(), schema.identifiable
            variance, shown = (np.einsum("jaa->ja", in_parents(schema.R0, x)) for x in tables)
            lam_std = np.where(shown > SHOWN_ALONE, np.sqrt(np.maximum(variance, 0.0)), np.nan)
            std = np.sqrt(np.maximum(theta.covariance().diagonal(), 0.0))
            bodies = std[: 10 * (n + 1)].reshape(-1, 10)
            rows = np.r_[: n - 1, n] if theta.spare_in_use else np.arange(n)
            self._std = lam_std, bodies[rows], std[10 * (n + 1) :].reshape(-1, n)
        self._calls += 1
        good = learner.verdict.good
        measured = learner.schema.kind == LinkMotionKind.MEASURED
        return Snapshot(
            lam=learner.schema.lam,
            lam_std=self._std[0],
            theta=learner.theta.theta,
            theta_std=self._std[1],
            effects=learner.theta.effect_values,
            effects_std=self._std[2],
            effect_shapes=learner.theta.shapes,
            torque_std=np.sqrt(learner.theta.variance()),
            lam_converged=good and learner.schema.converged,
            theta_converged=good and learner.theta_converged,
            stamp_ns=learner.stamp_ns,
            learned=learner.learned,
            lambda_source=LAMBDA_MEASURED if measured else LAMBDA_REPRODUCED,
        )


def news_of(learner: OnlineLearner) -> dict[str, Any]:
    """What was found so far, for whoever looks at the run; see `SnapshotReader.read_news`."""
    reports = [] if learner.watch is None else learner.watch.reports
    findings = list(reports[-MOST_FINDINGS:])
    changes = changes_at(learner.changes, learner.theta.payload, reports)[-MOST_FINDINGS:]
    load = changes[-1].get("payload") if changes else None
    news = {
        "theta_started": learner.theta_started_ns is not None,
        "load": None if load is None else {**load, "since_s": changes[-1]["stamp_s"]},
        "changes_s": [change["stamp_s"] for change in changes],
        "notes": [*learner.schema.notes, *learner.verdict.notes],
        "refusal": learner.verdict.refusal,
        "refused": learner.refused,
        "findings": findings,
    }
    while len(json_text(news).encode()) > NEWS_BYTES and findings:
        del findings[0]
    return dict(json_ready(news))
