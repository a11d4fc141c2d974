"""What every driver has to do, as checks that run on any of them.

A driver is entered as a `Rig`; `tests/drivers/test_every_driver.py` runs all `CHECKS` on it.
A machine that takes the processor away makes an arm fall silent, or stop: rightly, so that a
check then connects again and starts over. What is checked is what the samples and accounts say.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np
import pytest

from drivers.faults.driver import Account, FaultyDriver
from drivers.interface import Driver, DriverError, EndOfStream, Intake, JointSample
from tests.helpers.patience import connect, patient_read, patiently

READS = 200  # samples of a check
STILL_READS, MOST_READS = 15, 3000

Start = Callable[[], Driver]
T = TypeVar("T")


@dataclass(frozen=True)
class Rig:
    """A driver under test.

    Attributes:
        name: of the driver, for people.
        start: opens what the driver speaks to (a server, a file) and gives what makes drivers.
        ends: its samples come to an end, after at least `READS`.
        moves: commands are accepted.
        steady: the stamps are a period apart; false where the clock of a loaded machine paces.
        wire: a simulated arm moves in real time behind it; it runs by itself.
        faulty: faults put in on purpose, by name.
    """

    name: str
    start: Callable[[], AbstractContextManager[Start]]
    ends: bool = False
    moves: bool = True
    steady: bool = True
    wire: bool = False
    faulty: tuple[str, ...] = ()

    def takes(self, check: Callable[[Rig, Make], None]) -> bool:
        """Whether a check has anything to look at here."""
        needs = {it_holds_still_on_command: self.moves, the_end_is_told_and_stays: self.ends}
        return needs.get(check, True)


class Make:
    """Makes drivers of a rig; checks that need none of their own share a connected one.

    Attributes:
        begun_ns: when the shared one was about to connect, on the clock of arrivals.
    """

    def __init__(self, start: Start) -> None:
        self._start, self.begun_ns = start, 0
        self._shared: Driver | None = None

    def __call__(self) -> Driver:
        """A driver that is not connected; what was shared is closed, an arm serves one client."""
        self.let_go()
        return self._start()

    def connected(self) -> Driver:
        """The connected driver of the check before, or a new one."""
        if self._shared is None:
            arm, self.begun_ns = self._start(), time.monotonic_ns()
            connect(arm)
            self._shared = arm
        return self._shared

    def let_go(self) -> None:
        """Close what is shared, if there is something."""
        shared, self._shared = self._shared, None
        if shared is not None:
            shared.close()


def fresh(make: Make) -> Driver:
    """A driver of its own that has connected."""
    arm = make()
    connect(arm)
    return arm


def in_one_go(make: Make, action: Callable[[Driver], T]) -> T:
    """What the action gives on a connection that did not break meanwhile."""
    return patiently(lambda: action(make.connected()), make.let_go)


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
    arm = fresh(make)
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
    arm = fresh(make)
    patient_read(arm)
    arm.close()
    try:
        arm.connect()
    except DriverError as error:
        assert str(error).strip() and "\n" not in str(error)
        arm = fresh(make)  # then a new one must
    assert isinstance(patient_read(arm), JointSample)
    arm.close()


def samples_are_as_promised(rig: Rig, make: Make) -> None:
    """In order and finite; behind faults so but for as many as were put in, and no others."""
    if rig.faulty:  # whose account counts from the connection on
        make.let_go()
        samples = in_one_go(make, lambda arm: [arm.read() for _ in range(READS)])
        arm = make.connected()
    else:
        arm = make.connected()
        samples = [patient_read(arm) for _ in range(READS)]
    n = len(arm.joint_names)
    for sample in samples:
        assert isinstance(sample, JointSample) and type(sample.stamp_ns) is int
        for values in (sample.q, sample.dq, sample.tau):
            assert values.shape == (n,) and values.dtype == np.float64
        if sample.links is not None:
            assert len(arm.link_names) == n
            for values in (sample.links.twist, sample.links.accel):
                assert values.shape == (n, 6) and values.dtype == np.float64
    steps = np.diff([sample.stamp_ns for sample in samples])
    if rig.faulty:
        check_faults(rig, arm, samples, steps)
        return
    assert (steps > 0).all() and np.isfinite([sample.q for sample in samples]).any()
    assert not any(np.isinf((s.q, s.dq, s.tau)).any() for s in samples)
    if rig.steady:
        assert np.median(steps) == pytest.approx(arm.period_ns, rel=0.02)


def check_faults(rig: Rig, arm: Driver, samples: list[JointSample], steps: np.ndarray) -> None:
    """The account tells what was put in; whatever it does not tell of came through untouched."""
    account = account_of(arm)
    put_in = account.injected
    assert set(put_in) == set(rig.faulty) and min(put_in.values()) > 0
    assert account.delivered == len(samples) and account.balanced
    assert int((steps == 0).sum()) == put_in["repeated"]
    assert 0 < int((steps < 0).sum()) <= put_in["late"] + put_in["reordered"]
    true = {sample.stamp_ns: sample for sample in arm.driver.samples}
    altered = sum(not same(sample, true[sample.stamp_ns]) for sample in samples)
    hit = put_in["nan"] + put_in["corrupt"] + put_in["spike"]
    assert 0 < altered <= hit + put_in["repeated"]  # an altered one may come twice
    assert altered >= 0.5 * hit - 5  # some were lost or hit twice, some were NaN before


def same(one: JointSample, other: JointSample) -> bool:
    """Whether all numbers of two samples are the same, to the last bit."""
    pairs = [(one.q, other.q), (one.dq, other.dq), (one.tau, other.tau)]
    if one.links is not None and other.links is not None:
        pairs += [(one.links.twist, other.links.twist), (one.links.accel, other.links.accel)]
    return all(a.tobytes() == b.tobytes() for a, b in pairs)


class Tapped:
    """A driver that remembers the samples it gave out."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self.samples: list[JointSample] = []

    def __getattr__(self, name: str):
        return getattr(self._driver, name)

    def read(self) -> JointSample:
        """The next sample."""
        self.samples.append(self._driver.read())
        return self.samples[-1]


def a_sample_kept_stays_as_it_is(rig: Rig, make: Make) -> None:
    arm = make.connected()
    kept = [patient_read(arm) for _ in range(5)]
    copies = [(s.stamp_ns, s.q.copy(), s.dq.copy(), s.tau.copy()) for s in kept]
    links = [None if s.links is None else s.links.twist.copy() for s in kept]
    for _ in range(50):
        patient_read(arm)
    for sample, (stamp_ns, q, dq, tau), twist in zip(kept, copies, links, strict=True):
        assert sample.stamp_ns == stamp_ns
        for now, then in ((sample.q, q), (sample.dq, dq), (sample.tau, tau)):
            assert np.array_equal(now, then, equal_nan=True)
        if twist is not None:
            assert sample.links is not None
            assert np.array_equal(sample.links.twist, twist, equal_nan=True)


def bad_commands_are_refused(rig: Rig, make: Make) -> None:
    arm = make.connected()
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


def it_holds_still_on_command(rig: Rig, make: Make) -> None:
    """On commands of what carries it, the arm stays where it was, as most samples say.

    Medians are not moved by single wrong numbers.
    """
    before, after = in_one_go(make, held)
    q0, q1 = (np.nanmedian([s.q for s in part], axis=0) for part in (before, after))
    speed = np.nanmedian([s.dq for s in after], axis=0)
    assert np.isfinite(q1).all() and (np.abs(q1 - q0) < 0.05).all()  # rad
    assert (np.abs(speed) < 0.5).all()  # rad/s
    make.connected().stop()


def held(arm: Driver) -> tuple[list[JointSample], list[JointSample]]:
    """Samples of an arm before and while it is commanded what carries it."""
    before = [arm.read() for _ in range(STILL_READS)]
    none = np.zeros(len(arm.joint_names))
    while not np.isfinite(np.nanmedian([s.tau for s in before], axis=0)).all():
        before.append(arm.read())  # joints that a busy machine kept from answering
        assert len(before) < MOST_READS
    own = none if arm.adds_gravity else np.nanmedian([s.tau for s in before], axis=0)
    after = []
    for _ in range(3 * STILL_READS):
        arm.command(own)
        after.append(arm.read())
    return before, after


def the_intake_balances(rig: Rig, make: Make) -> None:
    arm = make.connected()
    for _ in range(READS):
        patient_read(arm)
        intake = arm.intake
        assert intake.received == intake.used + sum(intake.refused.values())
    assert intake.used > 0 and intake.lost >= 0
    assert all(reason and count >= 0 for reason, count in intake.refused.items())
    for note in intake.notes:
        assert note.strip() and "\n" not in note and len(note) <= 300
    assert len(set(intake.notes)) == len(intake.notes)


def arrivals_follow_the_clock(rig: Rig, make: Make) -> None:
    arm = make.connected()
    instants = []
    for _ in range(50):
        patient_read(arm)
        instants.append(arm.arrived_ns)
    assert all(a <= b for a, b in pairwise(instants))
    if arm.paced:
        assert make.begun_ns <= instants[0] and instants[-1] <= time.monotonic_ns()


def the_end_is_told_and_stays(rig: Rig, make: Make) -> None:
    arm = fresh(make)
    count = 0
    with pytest.raises(EndOfStream):
        while True:
            arm.read()
            count += 1
    assert count >= READS
    for _ in range(2):
        with pytest.raises(EndOfStream):
            arm.read()
    if rig.faulty:  # what was held back came before the end; what is missing was taken on purpose
        account = account_of(arm)
        assert account.balanced and account.waiting == 0
        assert (
            account.delivered
            == count
            == account.taken + (account.injected["repeated"] - account.injected["lost"])
        )
    arm.stop()
    arm.close()
    refusal(arm.read)
    arm.connect()  # from the beginning
    assert isinstance(arm.read(), JointSample)
    arm.close()


def account_of(arm: Driver) -> Account:
    """Of the faults put into an arm's samples."""
    assert isinstance(arm, FaultyDriver)
    return arm.account


CHECKS = (  # first those that share a connection
    samples_are_as_promised,
    a_sample_kept_stays_as_it_is,
    arrivals_follow_the_clock,
    the_intake_balances,
    bad_commands_are_refused,
    it_holds_still_on_command,
    it_says_what_it_is,
    nothing_works_before_connect,
    stop_and_close_may_come_at_any_time,
    it_connects_again_or_says_why_not,
    the_end_is_told_and_stays,
)
