"""Commands stay inside every limit, whatever the samples do."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adapter.control.controller import ExcitationController
from adapter.control.limits import MotionLimits
from adapter.control.settings import ExcitationSettings
from adapter.errors import ControlError
from adapter.model.robots import documented
from adapter.realtime.session import run_lockstep
from adapter.signals.front_end import FrontEnd
from drivers.faults.driver import with_faults
from drivers.interface import JointSample
from sim.plant import SimulatedArm
from sim.scenarios import build

PANDA = documented("panda")
LIMITS = MotionLimits.of(PANDA)
READY = build("nominal").truth.ready
PERIOD_NS, TICKS = 1_000_000, 1300
INERTIA = np.array([1.5, 1.5, 1.0, 1.0, 0.05, 0.05, 0.02])  # kg m², about those of a Panda
HELD = np.array([0.0, -30.0, 0.0, 15.0, 1.0, 2.0, 0.0])  # N m
MOTION = ExcitationSettings(seed=7, start_s=0.3, stop_s=0.3)


class Arm:
    """Seven free joints that carry themselves; one tick is one period of true time."""

    paced, adds_gravity, period_ns, arrived_ns = True, False, PERIOD_NS, 1
    delay_ns = PERIOD_NS
    joint_names = PANDA.tree.joint_names

    def __init__(self) -> None:
        self.q, self.dq, self.speeds = READY.copy(), np.zeros(7), []

    def tick(self, tau) -> None:
        self.dq = self.dq + 1e-3 * (tau - HELD) / INERTIA
        self.q = self.q + 1e-3 * self.dq
        self.speeds.append(self.dq)

    def sample(self, tick: int) -> JointSample:
        return JointSample(tick * PERIOD_NS, self.q, self.dq, HELD)


@dataclass
class Fault:
    kind: str
    at: int
    length: int = 1
    joint: int = 0
    size: float = 0.0

    def on(self, tick: int) -> bool:
        return self.at <= tick < self.at + self.length


ANY_TICK = st.integers(0, TICKS - 1)
JOINT = st.integers(0, 6)
CLOCKS = st.one_of(
    st.integers(-30, 30).map(lambda ms: 1e-3 * ms), st.sampled_from([-3600.0, -1.0, 1.0, 3600.0])
)
faults = st.lists(
    st.one_of(
        st.builds(Fault, st.sampled_from(["nan", "lost"]), ANY_TICK, st.integers(1, 30)),
        # Held back for longer, the reference waits: the arm has tripped by then, or stood still.
        st.builds(Fault, st.just("held"), ANY_TICK, st.integers(1, 3)),
        st.builds(Fault, st.sampled_from(["repeated", "stale", "swapped"]), ANY_TICK),
        st.builds(Fault, st.just("stuck"), ANY_TICK, st.integers(1, 400), JOINT),
        st.builds(Fault, st.just("jump"), ANY_TICK, st.just(TICKS), JOINT, st.floats(-1, 1)),
        st.builds(Fault, st.just("spike"), ANY_TICK, st.just(1), JOINT, st.floats(-100, 100)),
        st.builds(Fault, st.just("fast"), ANY_TICK, st.just(1), JOINT, st.floats(-1e6, 1e6)),
        st.builds(Fault, st.just("clock"), ANY_TICK, st.just(TICKS), st.just(0), CLOCKS),
    ),
    max_size=6,
)


class Line:
    """What arrives in each tick of true time: the samples of an arm, as faults leave them."""

    def __init__(self, faults: list[Fault]) -> None:
        self._faults, self._last, self._queue = faults, None, []
        self._frozen: dict[int, tuple[float, float]] = {}

    def arrive(self, sample: JointSample, tick: int) -> list[JointSample]:
        on = [fault for fault in self._faults if fault.on(tick)]
        q, dq, stamp_ns = sample.q.copy(), sample.dq.copy(), sample.stamp_ns
        for fault in on:
            j = fault.joint
            if fault.kind == "nan":
                q[fault.at % 7] = dq[(fault.at + 3) % 7] = np.nan
            elif fault.kind == "stuck":
                q[j], dq[j] = self._frozen.setdefault(id(fault), (q[j], dq[j]))
            elif fault.kind in ("jump", "spike"):
                q[j] += fault.size
            elif fault.kind == "fast":
                dq[j] += fault.size
            elif fault.kind == "clock":
                stamp_ns += round(1e9 * fault.size)
        sample = replace(sample, stamp_ns=stamp_ns, q=q, dq=dq)
        kinds = {fault.kind for fault in on}
        before, self._last = self._last, sample
        if "lost" in kinds:
            return []
        self._queue.append(sample)
        if kinds & {"held", "swapped"}:
            return []
        swapped = any(f.kind == "swapped" and f.on(tick - 1) for f in self._faults)
        out, self._queue = self._queue, []
        if swapped:
            out.reverse()
        if "stale" in kinds and before is not None:
            out = [before]
        return out + out[-1:] if "repeated" in kinds else out


class Record:
    """Reference and command of each call, in true time, and why the controller gave up."""

    def __init__(self) -> None:
        self.ticks, self.q, self.tau, self.said = [], [], [HELD.copy()], None

    def add(self, tick: int, q, tau) -> None:
        assert np.isfinite(tau).all()
        self.tau.append(tau)
        if self.ticks and self.ticks[-1] == tick:
            assert (q == self.q[-1]).all()  # nothing moves where no time goes by
            return
        self.ticks.append(tick)
        self.q.append(q)

    def check(self, share: float) -> None:
        """All limits; with divided differences, which a bounded derivative bounds."""
        steps = np.abs(np.diff(np.array(self.tau), axis=0))
        assert (steps <= share * LIMITS.torque_rate * 1e-3 + 1e-9).all()
        assert (np.abs(np.array(self.tau)) <= 0.95 * LIMITS.effort + 1e-9).all()
        if len(self.q) < 5:
            return
        t, q = 1e-3 * np.array(self.ticks), np.array(self.q)
        assert (q >= LIMITS.lower).all() and (q <= LIMITS.upper).all()
        table, factor = q, 1.0
        for order, limit in enumerate((LIMITS.velocity, LIMITS.acceleration, LIMITS.jerk), 1):
            table = np.diff(table, axis=0) / (t[order:] - t[:-order])[:, None]
            factor *= order
            assert (factor * np.abs(table) <= limit).all(), order


@settings(max_examples=50, deadline=None)
@given(
    faults=faults,
    stop=st.one_of(st.none(), ANY_TICK),
    seed=st.integers(0, 1000),
    late=st.floats(0.0, 0.3),
)
def test_every_limit_holds_in_the_arm_s_own_time_whatever_arrives(faults, stop, seed, late):
    arm, rng = Arm(), np.random.default_rng(seed)
    controller = ExcitationController(LIMITS, replace(MOTION, seed=seed))
    controller.attend(arm)
    played(arm, controller, faults, stop, lambda: late * rng.random()).check(share=0.9)


def played(arm, controller, faults, stop, late=None) -> Record:
    """What is commanded where the faults act, with instants that are late by so many periods."""
    line, record, tau, calls = Line(faults), Record(), HELD, 0
    controller.prepare(arm.sample(0))
    try:
        for tick in range(TICKS):
            if tick == stop:
                controller.begin_stop()
            instant = 10**15 + tick * PERIOD_NS + round(late() * PERIOD_NS) if late else 0
            for sample in line.arrive(arm.sample(tick), tick):
                tau, calls, ref = controller.step(sample, instant), calls + 1, controller.reference
                record.add(tick if late else calls, ref.q, tau)
                assert (np.abs(ref.dq) <= LIMITS.velocity).all()
                assert (np.abs(ref.ddq) <= LIMITS.acceleration).all()
            arm.tick(tau)
    except ControlError as error:
        record.said = str(error)
        assert faults and "joint" in record.said
    return record


@settings(max_examples=25, deadline=None)
@given(faults=faults, stop=st.one_of(st.none(), ANY_TICK), seed=st.integers(0, 1000))
def test_by_stamps_alone_no_command_is_too_much_and_no_reference_too_fast(faults, stop, seed):
    controller = ExcitationController(LIMITS, replace(MOTION, seed=seed))
    record = played(Arm(), controller, faults, stop)
    record.q.clear()  # in whose time these were, stamps alone cannot tell
    record.check(share=1.0)


@cache
def _calm():
    """Speeds of the arm without faults, where nothing is refused."""
    speeds, said, controller = _run([])
    assert said is None and controller.tracking()["unusable"] == 0
    return speeds


def _run(faults: list[Fault]):
    """The arm's own speeds, why the controller gave up, and the controller."""
    arm, controller = Arm(), ExcitationController(LIMITS, MOTION)
    controller.attend(arm)
    said = played(arm, controller, faults, None, lambda: 0.0).said
    return np.array(arm.speeds), said, controller


@pytest.mark.parametrize("size", [-0.3, 0.05])
def test_a_jump_of_an_encoder_stops_the_arm_and_does_not_fling_it(size):
    calm = _calm()
    speeds, said, _ = _run([Fault("jump", 700, TICKS, 1, size)])
    assert said is not None and "joint 2" in said and "encoder" in said
    assert 700 < len(speeds) < 725
    np.testing.assert_array_equal(speeds[:700], calm[:700])
    assert np.abs(speeds[700:] - calm[700 : len(speeds)]).max() < 0.4


def test_a_single_spike_changes_next_to_nothing():
    calm = _calm()
    speeds, said, controller = _run([Fault("spike", 700, 1, 1, 0.5)])
    assert said is None and controller.tracking()["unusable"] == 1
    assert np.abs(speeds - calm).max() < 0.02


def test_a_joint_that_reads_the_same_while_it_should_move_stops_the_arm():
    speeds, said, _ = _run([Fault("stuck", 500, TICKS, 0)])
    assert said is not None and "joint 1 reads the same" in said
    assert (np.abs(speeds) <= LIMITS.velocity).all()


def test_a_short_hole_is_bridged_and_a_long_one_stops():
    assert _run([Fault("lost", 600, 15)])[1] is None
    said = _run([Fault("lost", 600, 25)])[1]
    assert said is not None and "no usable joint reading for 0.02 s" in said


@pytest.mark.parametrize("seconds", [3600.0, -3600.0, -0.005])
def test_a_clock_that_is_set_is_no_hole(seconds):
    calm = _calm()
    speeds, said, _ = _run([Fault("clock", 600, TICKS, 0, seconds)])
    assert said is None
    assert np.abs(speeds - calm).max() < 0.1


# Joint 2 jumps by 0.5 rad, joint 6 by 0.05; joint 5 reads the same for good; nothing is a number.
@pytest.mark.parametrize("text", ["jump:2@1.5+0.5", "jump:6@1.5+0.05", "stuck:5@1.5+9", "nan=0.99"])
def test_the_simulated_arm_is_braked_inside_its_limits(text):
    plant = build("nominal", seed=3).plant()
    controller = ExcitationController(LIMITS, ExcitationSettings(seed=3))
    arm = with_faults(SimulatedArm(plant), text)
    result = run_lockstep(arm, FrontEnd(PANDA), None, controller, 10.0)
    assert result.ended == "driver_error" and "joint" in result.fault
    assert plant.fault is None and plant.braked  # the arm itself had nothing to say
    before = plant.link_state()[0].copy()
    for _ in range(500):
        plant.read()
    q, dq, _ = plant.link_state()
    assert np.abs(dq).max() < 0.01 and np.abs(q - before).max() < 0.3
    assert plant.fault is None
    arm.close()
