"""What every driver has to do, as checks that run on any of them.

A driver is entered as a `Rig`; `tests/contract/test_every_driver.py` runs all `CHECKS` on it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest

from drivers.interface import Driver, DriverError, EndOfStream, Intake, JointSample

READS = 200  # samples of a check
FIRST_WAIT_S = 20.0  # a simulated arm beside seven busy processes takes its time
LONGEST_NOTE = 300  # characters

Make = Callable[[], Driver]


@dataclass(frozen=True)
class Rig:
    """A driver under test.

    Attributes:
        name: of the driver, for people.
        start: opens what the driver speaks to (a server, a file) and gives a maker of drivers.
        ends: its samples come to an end, after at least `READS`.
        in_order: its stamps strictly increase; false where faults are put in on purpose.
        moves: commands are accepted.
        steady: the stamps are a period apart; false where the clock of a loaded machine paces.
    """

    name: str
    start: Callable[[], AbstractContextManager[Make]]
    ends: bool = False
    in_order: bool = True
    moves: bool = True
    steady: bool = True


def patient_read(arm: Driver) -> JointSample:
    """The next sample; a machine under load may make an arm fall silent for a moment."""
    end = time.monotonic() + FIRST_WAIT_S
    while True:
        try:
            return arm.read()
        except EndOfStream:
            raise
        except DriverError:
            if time.monotonic() > end:
                raise
            arm.close()
            arm.connect()


def connected(make: Make) -> Driver:
    """A driver that has connected."""
    arm = make()
    arm.connect()
    return arm


def refusal(action: Callable[[], object]) -> str:
    """The action must raise a DriverError of one plain sentence; the sentence."""
    with pytest.raises(DriverError) as caught:
        action()
    said = str(caught.value)
    assert said.strip() and "\n" not in said, said
    return said


def it_says_what_it_is(rig: Rig, make: Make) -> None:
    arm = make()
    n = len(arm.joint_names)
    assert n >= 1 and len(set(arm.joint_names)) == n
    assert all(isinstance(name, str) and name for name in arm.joint_names)
    assert isinstance(arm.joint_names, tuple) and isinstance(arm.link_names, tuple)
    assert len(arm.link_names) in (0, n)
    assert isinstance(arm.period_ns, int) and arm.period_ns > 0
    for flag in (arm.paced, arm.can_move, arm.adds_gravity):
        assert isinstance(flag, bool)
    assert arm.can_move == rig.moves
    assert isinstance(arm.intake, Intake) and isinstance(arm.arrived_ns, int)


def nothing_works_before_connect(rig: Rig, make: Make) -> None:
    arm = make()
    refusal(arm.read)
    refusal(lambda: arm.command(np.zeros(len(arm.joint_names))))
    arm.stop()
    arm.stop()
    arm.close()
    arm.close()


def stop_and_close_may_come_at_any_time(rig: Rig, make: Make) -> None:
    arm = connected(make)
    arm.stop()
    patient_read(arm)
    arm.stop()
    arm.stop()
    arm.close()
    arm.stop()
    arm.close()
    refusal(arm.read)
    refusal(lambda: arm.command(np.zeros(len(arm.joint_names))))


def it_connects_again_or_says_why_not(rig: Rig, make: Make) -> None:
    arm = connected(make)
    patient_read(arm)
    arm.close()
    try:
        arm.connect()
    except DriverError as error:
        assert str(error).strip() and "\n" not in str(error)
        arm = connected(make)  # then a new one must
    assert isinstance(patient_read(arm), JointSample)
    arm.close()


def check_sample(arm: Driver, sample: JointSample) -> None:
    """Shapes, types and the range of numbers of one sample."""
    n = len(arm.joint_names)
    assert isinstance(sample, JointSample) and type(sample.stamp_ns) is int
    for values in (sample.q, sample.dq, sample.tau):
        assert values.shape == (n,) and values.dtype == np.float64
        assert not np.isinf(values).any()
    if sample.links is not None:
        assert len(arm.link_names) == n
        for values in (sample.links.twist, sample.links.accel):
            assert values.shape == (n, 6) and values.dtype == np.float64


def samples_are_as_promised(rig: Rig, make: Make) -> None:
    arm = connected(make)
    samples = [patient_read(arm) for _ in range(READS)]
    if rig.in_order:
        for sample in samples:
            check_sample(arm, sample)
        stamps = np.array([sample.stamp_ns for sample in samples])
        assert (np.diff(stamps) > 0).all()
        assert np.isfinite(np.array([sample.q for sample in samples])).any()
    if rig.in_order and rig.steady:
        assert np.median(np.diff(stamps)) == pytest.approx(arm.period_ns, rel=0.02)
    arm.close()


def a_sample_kept_stays_as_it_is(rig: Rig, make: Make) -> None:
    arm = connected(make)
    kept = [patient_read(arm) for _ in range(5)]
    copies = [(s.stamp_ns, s.q.copy(), s.dq.copy(), s.tau.copy()) for s in kept]
    links = [None if s.links is None else s.links.twist.copy() for s in kept]
    for _ in range(50):
        patient_read(arm)
    arm.close()
    for sample, (stamp_ns, q, dq, tau), twist in zip(kept, copies, links, strict=True):
        assert sample.stamp_ns == stamp_ns
        for now, then in ((sample.q, q), (sample.dq, dq), (sample.tau, tau)):
            assert np.array_equal(now, then, equal_nan=True)
        if twist is not None:
            assert sample.links is not None
            assert np.array_equal(sample.links.twist, twist, equal_nan=True)


def bad_commands_are_refused(rig: Rig, make: Make) -> None:
    arm = connected(make)
    n = len(arm.joint_names)
    patient_read(arm)
    bad = [np.zeros(n + 1), np.zeros((1, n)), np.zeros(0)]
    bad += [np.where(np.arange(n) == n - 1, value, 0.0) for value in (np.nan, np.inf, -np.inf)]
    if not arm.can_move:
        bad.append(np.zeros(n))
    for tau in bad:
        refusal(lambda tau=tau: arm.command(tau))
    assert isinstance(patient_read(arm), JointSample)  # none the worse for it
    arm.stop()
    arm.close()


def it_holds_still_on_command(rig: Rig, make: Make) -> None:
    arm = connected(make)
    if arm.can_move:
        n = len(arm.joint_names)
        first = sample = patient_read(arm)
        for _ in range(20):
            own = np.zeros(n) if arm.adds_gravity else np.nan_to_num(first.tau)
            arm.command(own)
            sample = patient_read(arm)
        if rig.in_order:
            moved = np.abs(sample.q - first.q)
            assert not (moved > 0.05).any()  # rad; NaN where nothing was measured
        arm.stop()
        arm.stop()
    arm.close()


def the_intake_balances(rig: Rig, make: Make) -> None:
    arm = connected(make)
    for _ in range(READS):
        patient_read(arm)
        intake = arm.intake
        assert intake.received == intake.used + sum(intake.refused.values())
    arm.close()
    assert intake.used > 0 and intake.lost >= 0
    assert all(reason and count >= 0 for reason, count in intake.refused.items())
    for note in intake.notes:
        assert note.strip() and "\n" not in note and len(note) <= LONGEST_NOTE
    assert len(set(intake.notes)) == len(intake.notes)


def arrivals_follow_the_clock(rig: Rig, make: Make) -> None:
    begin_ns = time.monotonic_ns()
    arm = connected(make)
    instants = []
    for _ in range(50):
        patient_read(arm)
        instants.append(arm.arrived_ns)
    arm.close()
    assert all(a <= b for a, b in pairwise(instants))
    if arm.paced:
        assert begin_ns <= instants[0] and instants[-1] <= time.monotonic_ns()


def the_end_is_told_and_stays(rig: Rig, make: Make) -> None:
    if not rig.ends:
        return
    arm = connected(make)
    count = 0
    with pytest.raises(EndOfStream):
        while True:
            arm.read()
            count += 1
    assert count >= READS
    with pytest.raises(EndOfStream):
        arm.read()
    arm.stop()
    arm.close()


CHECKS = (
    it_says_what_it_is,
    nothing_works_before_connect,
    stop_and_close_may_come_at_any_time,
    it_connects_again_or_says_why_not,
    samples_are_as_promised,
    a_sample_kept_stays_as_it_is,
    bad_commands_are_refused,
    it_holds_still_on_command,
    the_intake_balances,
    arrivals_follow_the_clock,
    the_end_is_told_and_stays,
)
