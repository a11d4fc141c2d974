"""The controller's start, an arm that carries its own weight, and time from stamps that lie."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from adapter.control.controller import ControlSettings, ExcitationController
from adapter.control.feedforward import ModelFeedforward
from adapter.control.limits import MotionLimits
from adapter.control.reading_gate import SampleClock
from adapter.control.settings import ExcitationSettings, SafetySettings
from adapter.errors import ControlError, SettingsError
from adapter.model.robots import documented
from drivers.interface import JointSample
from sim.scenarios import build
from tests.helpers.lockstep_drivers import opened

PANDA = documented("panda")
LIMITS = MotionLimits.of(PANDA)
READY = build("nominal").truth.ready
MS = 1_000_000


class Floating:
    """What a controller has to know of an arm that carries its own weight.

    It acts upon a command `delay_ns` after the sample.
    """

    paced, adds_gravity, period_ns, arrived_ns = True, True, MS, 1
    joint_names = PANDA.tree.joint_names

    def __init__(self, delay_ns: int = MS) -> None:
        self.delay_ns = delay_ns


def _sample(k: int, q=READY, tau=None) -> JointSample:
    return JointSample(k * MS, q, np.zeros(7), np.full(7, 5.0) if tau is None else tau)


def test_the_first_command_is_what_the_arm_holds_itself_with():
    held = np.array([0.0, -30.0, 1.0, 15.0, 1.0, 2.0, 0.1])
    controller = ExcitationController(LIMITS)
    np.testing.assert_array_equal(controller.step(_sample(0, tau=held)), held)
    floating = ExcitationController(LIMITS)
    floating.attend(Floating())
    floating.prepare(_sample(0, tau=np.full(7, np.nan)))  # its torque is of no interest
    np.testing.assert_array_equal(floating.step(_sample(0)), np.zeros(7))


@pytest.mark.parametrize(
    ("delay_ns", "share"), [(0, 1.0), (MS // 2, 1.0), (MS, 1.0), (2 * MS, 0.5), (5 * MS, 0.2)]
)
def test_damping_is_as_gentle_as_the_arm_is_late(delay_ns: int, share: float) -> None:
    damping = np.linspace(1.0, 7.0, 7)
    gains = ControlSettings(stiffness=np.zeros(7), damping=damping)
    controller = ExcitationController(LIMITS, control=gains)
    controller.attend(Floating(delay_ns))
    controller.prepare(_sample(0))
    controller.step(_sample(0), 1)
    dq = np.array([0.1, -0.1] * 3 + [0.1])
    tau = controller.step(JointSample(MS, READY, dq, np.zeros(7)), MS + 1)
    reference = controller.reference
    assert reference is not None and np.abs(reference.dq).max() < 1e-4
    np.testing.assert_allclose(tau, share * damping * (reference.dq - dq), atol=1e-12)


class Always:
    """A model that gives the same torque of every joint."""

    ready, notes, unbent = True, (), np.zeros_like

    def __init__(self, torque: float) -> None:
        self.torque = torque

    def refresh(self) -> None: ...

    def __call__(self, q, dq, ddq):
        return np.full(7, self.torque)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_commands_end_at_the_effort_and_step_no_further_than_the_rate(sign: float) -> None:
    """Upwards as downwards; by instants 0.9 of the step that the rate allows."""

    for instants, most in ((True, 0.9), (False, 1.0)):
        patient = ControlSettings(safety=SafetySettings(saturated_s=1.0))
        controller = ExcitationController(LIMITS, None, patient, Always(sign * 1e4))
        controller.attend(Floating())
        controller._adds_gravity = False  # the model's torque as it is
        controller.prepare(_sample(0, tau=np.zeros(7)))
        way = []
        for k in range(300):
            q = controller.reference.q + 1e-7 * k  # it follows, and is read anew
            now_ns = 1 + k * MS if instants else 0
            sample = JointSample(k * MS, q, controller.reference.dq, np.zeros(7))
            way.append(controller.step(sample, now_ns))
        steps = sign * np.diff(np.array(way), axis=0)
        assert steps.max() == pytest.approx(most) and steps.min() >= 0.0
        np.testing.assert_allclose(sign * way[-1], 0.95 * LIMITS.effort)
        tracking = controller.tracking()
        assert tracking["saturated"] > 200 and tracking["rate_limited"] > 40


def test_an_arm_that_carries_itself_gets_no_gravity_from_feedback_nor_model():
    from adapter.realtime.session import run_lockstep
    from adapter.signals.front_end import FrontEnd

    worst = {}
    for name, model in (("feedback", None), ("model", ModelFeedforward.of(PANDA))):
        controller = ExcitationController(LIMITS, ExcitationSettings(seed=3), feedforward=model)
        commands = []
        each = lambda sample, tau, to=commands: to.append(tau)  # noqa: E731
        with opened("fci", build("nominal", noise="none")) as (arm, _):
            result = run_lockstep(arm, FrontEnd(PANDA), None, controller, 3.0, each=each)
        assert (result.ended, result.fault) == ("duration", None)
        found = controller.tracking()["feedback" if model is None else "feedforward"]
        worst[name] = max(found["max_rad"])
        np.testing.assert_array_equal(commands[0], np.zeros(7))
        assert np.abs(commands[-1]).max() < 3.0  # at rest: no weight in it
    assert worst["model"] < 0.01 and worst["model"] < 0.5 * worst["feedback"] < 0.1


@pytest.mark.parametrize(
    ("sample", "said"),
    [
        (_sample(0, q=np.r_[READY[:6], np.nan]), "joint 7 gives no position"),
        (_sample(0, tau=np.r_[np.nan, np.zeros(6)]), "joint 1 gives no torque"),
    ],
)
def test_nothing_starts_from_what_is_not_measured(sample, said):
    with pytest.raises(SettingsError, match=said):
        ExcitationController(LIMITS).prepare(sample)


def test_an_arm_that_was_moved_after_the_plan_does_not_start():
    controller = ExcitationController(LIMITS)
    controller.prepare(_sample(0))
    with pytest.raises(ControlError, match=r"joint 2 moved by 0\.050 rad between"):
        controller.step(_sample(60_000, q=READY + 0.05 * np.eye(7)[1]))


def test_it_starts_however_long_ago_it_was_prepared():
    controller = ExcitationController(LIMITS)
    controller.attend(Floating())
    controller.prepare(_sample(0))
    controller.step(_sample(60_000), 10**12)
    controller.step(_sample(60_001), 10**12 + MS)
    assert controller.reference.time_s == pytest.approx(1e-3)


def test_nonsense_of_a_model_never_becomes_a_command():
    controller = ExcitationController(LIMITS, feedforward=Always(np.nan))
    controller.step(_sample(0))
    with pytest.raises(ControlError, match="not a finite number"):
        for k in range(1, 10):
            controller.step(_sample(k))


@pytest.mark.parametrize(
    ("stamps", "steps"),
    [
        ([5, 6, 7, 9], [0, 1, 1, 2]),
        ([5, 6, 6, 7], [0, 1, 0, 1]),  # repeated
        ([1, 2, 4, 3, 5], [0, 1, 2, 0, 1]),  # reordered
        ([1, 2, 5000, 5001], [0, 1, 1, 1]),  # set forward
        ([900, 901, 1, 2, 3, 4, 5, 6], [0, 1, 0, 0, 0, 0, 1, 1]),  # set back
        ([1, 2, 5000, 3, 4, 5, 6, 7, 8], [0, 1, 1, 0, 0, 0, 0, 1, 1]),  # one wrong stamp
    ],
)
def test_steps_of_time_by_stamps_alone(stamps, steps):
    pace = SampleClock(MS, 20 * MS)
    assert [pace.step(stamp * MS) // MS for stamp in stamps] == steps


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    drift=st.floats(-2e-4, 2e-4),
    late=st.floats(0.0, 0.3),
    share=st.floats(0.0, 0.4),
)
def test_with_instants_no_tick_is_lost_or_invented(seed, drift, late, share):
    """Stamps are nonsense at `share` of the ticks, the two clocks drift apart, samples are lost."""
    rng = np.random.default_rng(seed)
    pace, before = SampleClock(MS, 20 * MS), 0
    for tick in range(2000):
        if tick and rng.random() < 0.1:
            continue
        stamp = tick * MS if rng.random() >= share else int(rng.integers(-(10**12), 10**12))
        now = 10**15 + round((1.0 + drift) * tick * MS + late * MS * rng.random())
        assert pace.step(stamp, now) == (tick - before) * MS
        before = tick
