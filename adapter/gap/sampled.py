"""A long recording as `gap` and `load` take it: screened in a part, searched in stretches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from adapter.gap.changes import Windows
from adapter.gap.long_recording import (
    SCREENED_S,
    LongRecording,
    Span,
    Survey,
    is_long,
    long_recording,
    surveyed,
)
from adapter.gap.nominal import nominal_fit
from adapter.gap.real_arm import real_arm
from adapter.gap.signals import RATE_HZ, Recorded
from adapter.model.self_model import SelfModel
from adapter.physics.rigid_arm import RigidArm
from adapter.screening.screen import Screened, moving_joints, of_this_robot, refuse, standing
from drivers.files.mcap import Log


@dataclass(frozen=True, eq=False)
class Sampled:
    """A long recording and what a search takes of it.

    Attributes:
        name: of it; whole: clean and smooth; model: of the arm.
        spans: the stretches, s.
        loads_s: about when what the hand holds changed, s.
    """

    name: str
    whole: LongRecording
    model: SelfModel
    spans: tuple[Span, ...]
    loads_s: tuple[float, ...] = ()

    @classmethod
    def of(cls, log: Log, name: str, model: SelfModel) -> Sampled:
        """A recording of a model's arm. Raises RecordingRefused: of another robot."""
        own = of_this_robot(log, model)
        whole = long_recording(own, surveyed(own))
        return cls(name, whole, model, tuple(whole.survey.spread(whole.span)))

    @property
    def survey(self) -> Survey:
        """A first look at it."""
        return self.whole.survey

    def within(self, span: Span) -> Sampled:
        """The same in a part of its time alone."""
        return replace(
            self,
            whole=replace(self.whole, span=span),
            spans=tuple(self.survey.spread(span)),
        )

    def recorded(self) -> Recorded:
        """Its stretches."""
        return replace(self.whole.recorded(self.spans, self.name), loads_s=self.loads_s)

    def with_changes(self, inertia_prior: float) -> Sampled:
        """With stretches where something changes or is loud, see `changes`."""
        period_s, own = self.survey.clock.period_s, self.recorded()
        nominal = nominal_fit([own], self.model, inertia_prior, period_s)
        told = sorted(nominal.heard.intersection(self.moving()))
        fit = real_arm(nominal, told, (0,)).fit.with_noise()
        windows = Windows.of(fit, self.whole)
        spans = tuple(sorted([*self.spans, *windows.stretches()]))
        return replace(self, spans=spans, loads_s=tuple(windows.loads_s))

    def moving(self) -> tuple[int, ...]:
        """Joints (from 0) that move enough in its stretches."""
        motion = self.whole.signals(self.spans, RigidArm.of(self.model)).motion
        return moving_joints(motion.q, motion.dq, 1.0 / RATE_HZ)

    def busiest(self, log: Log) -> Log:
        """The part in one piece in which most moves, of the recording as it was read."""
        return log.piece(*self.survey.busiest(SCREENED_S))

    def screened(self, log: Log) -> Screened:
        """Let the recording pass, as `screen.refuse` does. Raises RecordingRefused.

        Args:
            log: as it was read.
        """
        seen = refuse(self.busiest(log), self.model, RigidArm.of(self.model))
        motion = self.whole.signals(self.spans, RigidArm.of(self.model)).motion
        moving = self.moving() or seen.moving
        said = standing(self.model.tree.joint_names, moving, motion.q, motion.dq)
        return replace(seen, timing=self.survey.clock, moving=moving, standing=said)


def part_of(log: Log, model: SelfModel, end_s: float | None = None) -> Log:
    """Of a long recording the part in one piece in which most moves; a short one whole.

    Args:
        model: of the arm; end_s: the part lies before it, s.

    Raises:
        RecordingRefused: of another robot.
    """
    if is_long(log):
        survey = surveyed(of_this_robot(log, model))
        return log.piece(*survey.busiest(SCREENED_S, end_s))
    if end_s is None:
        return log
    return log.take(log.stamp_ns < log.first_ns + round(1e9 * end_s))


def sampling(recordings: Sequence[Recorded]) -> tuple[dict[str, Any], ...]:
    """What was taken of long recordings, for the JSON file."""
    alone = len(recordings) == 1
    return tuple(
        {
            "recording": own.name,
            "seconds": own.whole.seconds,
            "searched_s": own.seconds,
            "stretches_s": [[float(a), float(b)] for a, b in own.spans],
            "weighed_on_all": alone,
        }
        for own in recordings
        if own.whole is not None
    )


def sampling_words(recordings: Sequence[Recorded]) -> list[str]:
    """What was taken of long recordings, a sentence each."""
    alone, said = len(recordings) == 1, []
    for own in recordings:
        if own.whole is not None:
            who = "" if alone else f"{own.name}: "
            first, last = own.spans[0][0], own.spans[-1][1]
            said.append(
                f"{who}searched and scored in {own.seconds:.0f} s of {own.whole.seconds:.0f} s, "
                f"in {len(own.spans)} stretches from {first:.0f} s to {last:.0f} s"
                + (", weighed on all" if alone else "")
            )
    return said
