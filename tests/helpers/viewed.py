"""A short run of the simulated Panda, seen through the shared memory that displays look at."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from adapter.control.observer import ContactObserver
from adapter.realtime.loop_board import LoopBoard
from adapter.realtime.ring import Ring
from adapter.realtime.session import run_lockstep
from adapter.realtime.showing import Looker, View
from adapter.realtime.snapshot import ExternalTorque, SnapshotReader, SnapshotWriter
from adapter.realtime.timing import Timing
from adapter.runs.config import PipelineSettings
from adapter.runs.live import Publisher, news_of, single_thread_learner
from adapter.runs.pipeline import make_front_end
from adapter.view.now import KnownRun
from tests.helpers.live_tools import PANDA, parts, simulated_arm

EVERY = 50  # states between two looks
TICK_NS = 200_000
FRICTION = ("viscous_friction", "coulomb_friction")


@dataclass
class Seen:
    """A run: what was known of it, what a display saw, and the arm's own truth beside.

    Attributes:
        known: the run.
        views: in order; the last one is done.
        states: all filtered states, (m, size).
        residuals: (n,) N m of the newest state of each look, by the learner itself.
    """

    known: KnownRun
    views: list[View]
    states: np.ndarray
    residuals: list[np.ndarray]


def settings() -> PipelineSettings:
    """The usual ones, with friction."""
    usual = PipelineSettings()
    return replace(usual, learner=replace(usual.learner, effects=FRICTION))


def seen_run(seconds: float) -> Seen:
    """Drive the simulated arm, learn, publish, look: all of it real, in one thread."""
    pipeline, known = settings(), KnownRun(PANDA, FRICTION, "pybullet:panda", seconds, "a run")
    learner, publish = single_thread_learner(PANDA, pipeline, None), Publisher()
    front_end, controller = make_front_end(PANDA, pipeline), parts()[1]
    ring = Ring.create(front_end.layout.size, 4000)
    names = PANDA.tree.joint_names
    board, loop = SnapshotWriter.create(names, FRICTION, name=None), LoopBoard.create()
    reader, observer = SnapshotReader(board.name), ContactObserver(PANDA, FRICTION)
    looker, timing, views = Looker(ring, reader, loop), Timing(loop.bins), list[View]()
    states, residuals = list[np.ndarray](), list[np.ndarray]()

    class Published:
        """A learner whose estimate is published, and looked at."""

        def step(self, state: np.ndarray) -> None:
            if not states:
                loop.write_begin(int(state[:1].view(np.int64)[0]))
            states.append(state.copy())
            learner.step(state)
            ring.push(state)
            ring.release(1)
            timing.add(len(states) * 10**6, len(states) * 10**6, len(states) * 10**6 + TICK_NS, 0)
            if len(states) % EVERY == 0:
                board.publish(publish(learner))
                board.publish_news(news_of(learner))
                views.append(looker.look(False))
                tau = state[front_end.layout.joint_tau]
                residuals.append(tau - learner.predict(state[None])[0])

    def watch(sample, command) -> None:
        torque = observer.step(sample)
        wrench = observer.wrench()
        push = ExternalTorque(torque, observer.std, *wrench, None, False, sample.stamp_ns)
        board.publish_external(push)

    run_lockstep(simulated_arm(), front_end, Published(), controller, seconds, each=watch)
    loop.write_end("duration", None)
    ring.finish()
    views.append(replace(looker.look(True), elapsed_s=views[-1].elapsed_s + 1.0))
    for part in (reader, board, loop, ring):
        part.close()
    for made in (board, loop, ring):
        made.unlink()
    return Seen(known, views, np.array(states), residuals)


def again(views: list[View]) -> Iterator[View]:
    """The same without the end."""
    return (view for view in views if not view.done)
