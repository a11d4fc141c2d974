"""The driver of arms behind ros2_control, process to process over DDS on the loopback interface."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

cyclonedds = pytest.importorskip("cyclonedds", reason="pip install 'panda-adapter[ros]'")

from drivers.files.messages import JointStateEncoder, encode  # noqa: E402
from drivers.files.ros_types import FLOAT64_MULTI_ARRAY, JOINT_STATE  # noqa: E402
from drivers.interface import DriverError  # noqa: E402
from drivers.ros2.arm import Ros2Arm  # noqa: E402
from drivers.ros2.bridge import JUMPS, States, encode_command  # noqa: E402
from drivers.ros2.holding import Braker  # noqa: E402
from drivers.ros2.memory import Doing, Memory, Refusal  # noqa: E402
from drivers.ros2.settings import parse  # noqa: E402
from sim.ros2.arm import Float64MultiArray, Header, JointState, Layout, Time  # noqa: E402
from sim.scenarios import build  # noqa: E402
from tests.helpers.hardware_rigs import PANDA_JOINTS, free_domain, ros2_arm  # noqa: E402
from tests.helpers.patience import patient_read, patiently  # noqa: E402

COMMAND = "command=/effort_controller/commands"


def test_the_wire_is_that_of_ros_2():
    """Our bytes are those of Cyclone DDS from types written down separately."""
    q, dq, tau = np.arange(6.0).reshape(3, 2)
    theirs = JointState(
        Header(Time(7, 8), "f"), ["a", "bc"], q.tolist(), dq.tolist(), tau.tolist()
    ).serialize(use_version_2=False)
    assert JointStateEncoder(("a", "bc"), "f").encode(7 * 10**9 + 8, q, dq, tau) == theirs
    theirs = Float64MultiArray(Layout([], 0), [1.5, -2.0, 3.0]).serialize(use_version_2=False)
    assert encode_command(np.array([1.5, -2.0, 3.0])) == theirs
    fields = {"layout": {"dim": [], "data_offset": 0}, "data": [1.5, -2.0, 3.0]}
    assert encode(FLOAT64_MULTI_ARRAY, fields) == theirs
    assert JointState.__idl__.idl_transformed_typename == "sensor_msgs::msg::dds_::JointState_"


def test_types_are_made_from_the_definitions():
    from drivers.ros2.wire import dds_topic, dds_type, ros_schema, ros_topic

    name = dds_type(JOINT_STATE).__idl__.idl_transformed_typename
    assert name == "sensor_msgs::msg::dds_::JointState_" and ros_schema(name) == JOINT_STATE
    assert dds_topic("/joint_states") == "rt/joint_states"
    assert ros_topic("rt/joint_states") == "/joint_states" and not ros_topic("rq/service")


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("ros2://joint_states", "three slashes"),
        ("ros2:///a?speed=2", "no option 'speed'; have: command, domain"),
        ("ros2:///a?command=b", "command=b is no topic"),
        ("ros2:///a?domain=300", "from 0 to 232"),
        ("ros2:///a?hz=0", "hz is a number from 0.001 to 1000000.0, not .0."),
        ("ros2:///a?local=yes", "0 or 1"),
        ("ros2:///a", "which joints"),
        ("ros2:///a?joints=x,y", "motion needs command="),
    ],
)
def test_an_address_that_says_too_little(address, said):
    with pytest.raises(DriverError, match=said):
        Ros2Arm(address, None, allow_motion=True)


def test_the_domain_is_that_of_ros(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "17")
    assert parse("ros2:///a").domain == 17 and parse("ros2:///a?domain=3").domain == 3


def test_what_cannot_be_is_refused_and_counted():
    memory = Memory(2)
    states = States(("b", "a"), memory)
    encoder = JointStateEncoder(("a", "x", "b"))

    def message(stamp_ns, q):
        numbers = np.array([q[0], 9.0, q[1]])
        return encoder.encode(stamp_ns, numbers, numbers + 1, numbers + 2)

    stamp, values = states.take(message(10**9, (1.0, 2.0)))
    assert stamp == 10**9 and values.tolist() == [[2.0, 1.0], [3.0, 2.0], [4.0, 3.0]]
    bad = {
        Refusal.OLD: message(10**9, (1.0, 2.0)),
        Refusal.NOT_FINITE: message(10**9 + 1, (np.nan, 2.0)),
        Refusal.JUMP: message(10**9 + 10**6, (1.2, 2.0)),
        Refusal.UNREADABLE: b"\0\1\0\0abc",
        Refusal.OTHER_JOINTS: JointStateEncoder(("a",)).encode(2, *np.ones((3, 1))),
        Refusal.INCOMPLETE: JointStateEncoder(("a", "b"), fields=("position",)).encode(
            10**9 + 2, *np.ones((3, 2))
        ),
    }
    for data in bad.values():
        assert states.take(data) is None
    counts = memory.words.refused[:]
    assert all(counts[why] == 1 for why in bad) and sum(counts) == len(bad)
    assert states.take(message(10**9 + 10**7, (1.2, 2.1))) is not None  # in 10 ms it may have gone
    far = [states.take(message(2 * 10**9 + k, (40.0, 2.1))) for k in range(JUMPS + 1)]
    assert far[:JUMPS] == [None] * JUMPS and states.jumps == 0 and far[JUMPS] is not None


@pytest.mark.parametrize(("seed", "delay"), [(1, 3), (3, 1)])
def test_a_moving_arm_is_braked_and_held(seed, delay):
    """The simulated arm without a wire: torques act some periods late, its weight shifts."""
    plant, rng = build("nominal", seed).plant(substeps=2), np.random.default_rng(seed)
    sample, speed = plant.read(), rng.uniform(-0.6, 0.6, 7)
    start, stiff = sample.q, np.array([100, 100, 80, 80, 20, 15, 5.0])
    braker = Braker(plant.truth.limits.effort, 1e-3, gravity=False)
    for k in range(600):
        weight = plant._engine.drive_for(sample.q, sample.dq, np.zeros(7))
        away = start + 1e-3 * k * speed - sample.q
        plant.command(weight + stiff * away + 0.15 * stiff * (speed - sample.dq))
        sample = plant.read()
        braker.listen(sample.dq, sample.tau)
    assert np.abs(sample.dq).max() > 0.4
    begun, standing, pending = sample.q, sample.q, [sample.tau] * delay
    for k in range(3000):
        pending.append(braker.torques(sample.q, sample.dq, sample.tau))
        plant.command(pending.pop(0))
        sample = plant.read()
        standing = sample.q if k == 1500 else standing
    assert plant.fault is None and braker.standing
    assert np.abs(standing - begun).max() < 0.15
    # it sinks slowly: the braker finds the weight by its own torques, 10 mrad in 1.5 s at most here
    assert np.abs(sample.q - standing).max() < 0.015 and np.abs(sample.dq).max() < 0.05
    plant.close()


@pytest.mark.alone
def test_it_drives_brakes_and_says_why_not():
    """One simulated arm, several questions: a process each would take most of the time."""
    with ros2_arm() as address:
        stranger = Ros2Arm(address, ("panda_joint1", "panda_joint9"), False)
        with pytest.raises(DriverError, match="no joint panda_joint9; it has: panda_finger_joint1"):
            stranger.connect()
        wrong = Ros2Arm(address + "&hz=100", PANDA_JOINTS, False)
        with pytest.raises(DriverError, match="comes at 1000 Hz, not 100; say hz=1000"):
            wrong.connect()
        silent = Ros2Arm(address.replace("/joint_states", "/states"), PANDA_JOINTS, False)
        with pytest.raises(DriverError, match=r"0 joint states on /states .* published: /joint"):
            silent.connect()
        nobody = Ros2Arm(address.replace("effort_controller", "other"), PANDA_JOINTS, True)
        with pytest.raises(DriverError, match=r"no controller listens on /other/comm.*effort_"):
            nobody.connect()
        _moves_and_stops(address)
        _nobody_else_may_command(address)
        _silence_of_the_loop_brakes(address)
        _a_killed_loop_leaves_a_held_arm(address)


@contextmanager
def as_the_loop():
    """With the loop's priority, as far as the system permits; the arm's 50 ms are short."""
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(70))
    try:
        yield
    finally:
        with suppress(OSError):
            os.sched_setscheduler(0, *before)


@contextmanager
def connected(address):
    arm = Ros2Arm(address, PANDA_JOINTS, True)
    patiently(arm.connect, arm.close)
    try:
        yield arm
    finally:
        arm.close()


def push(arm, extra, ticks):
    """Command what carries the arm and `extra` on joint 1; the last sample. Raises DriverError."""
    with as_the_loop():
        return _push(arm, extra, ticks)


def _push(arm, extra, ticks):
    arm.read()
    while time.monotonic_ns() - arm.arrived_ns > 5_000_000:  # what came in before is no answer
        arm.read()
    carried = np.median([arm.read().tau for _ in range(30)], axis=0)
    for _ in range(ticks):
        arm.command(carried + np.r_[extra, np.zeros(6)])
        sample = arm.read()
    return sample


def _moves_and_stops(address):
    with connected(address) as arm:
        before = arm.read()

        def swing():
            """Until it has moved; beside busy processes that takes more samples."""
            with as_the_loop():
                sample = push(arm, 3.0, 50)
                while abs(sample.q[0] - before.q[0]) < 0.01:
                    arm.command(np.where(np.arange(7) == 0, 3.0, sample.tau))
                    sample = arm.read()
                    assert arm.intake.used < 20_000
                arm.stop()
                return sample

        moving = patiently(swing, lambda: (arm.close(), arm.connect()))
        assert moving.q[0] - before.q[0] > 0.0
        after = [arm.read() for _ in range(1500)]
        assert np.abs(np.median([s.dq for s in after[-100:]], axis=0)).max() < 0.05
        assert arm._bridge.memory.words.doing == Doing.HOLDING
        assert arm.intake.commands.sent >= 50 and arm.intake.commands.cut == 0
        assert arm.intake.received == arm.intake.used


def _nobody_else_may_command(address):
    with connected(address):
        second = Ros2Arm(address, PANDA_JOINTS, True)
        with pytest.raises(DriverError, match="somebody else publishes on /effort_controller"):
            second.connect()
        listener = Ros2Arm(address, PANDA_JOINTS, False)  # may listen beside it
        patiently(listener.connect, listener.close)
        with pytest.raises(DriverError, match="only listened to"):
            listener.command(np.zeros(7))
        listener.close()


def _silence_of_the_loop_brakes(address):
    with connected(address) as arm:
        patiently(lambda: push(arm, 1.0, 30), lambda: (arm.close(), arm.connect()))
        time.sleep(0.4)
        with pytest.raises(DriverError, match=r"no command came for \d+ ms; the arm is braked"):
            for _ in range(1000):
                arm.read()
        arm.stop()
        patiently(lambda: push(arm, 0.0, 10), lambda: (arm.close(), arm.connect()))  # goes on
        os.kill(arm._bridge.pid, signal.SIGKILL)
        with pytest.raises(DriverError, match="the bridge to DDS ended"):
            for _ in range(2000):
                arm.read()
        arm.stop()  # by a new bridge
        assert arm._bridge.memory.words.doing in (Doing.BRAKING, Doing.HOLDING)


LOOP = """
import sys
from tests.drivers.test_ros2_driver import PANDA_JOINTS, Ros2Arm, push
arm = Ros2Arm(sys.argv[1], PANDA_JOINTS, True)
arm.connect()
push(arm, 2.0, 60)
print("driving", flush=True)
push(arm, 2.0, 100_000)
"""


def _a_killed_loop_leaves_a_held_arm(address):
    """kill -9 of the driver's process while it drives: the bridge brakes the arm and holds it."""
    root = str(Path(__file__).parents[2])
    child = subprocess.Popen(
        [sys.executable, "-c", LOOP, address],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": root},
    )
    with child, child.stdout:
        said = child.stdout.readline()
        child.kill()
    assert said == b"driving\n"
    listener = Ros2Arm(address, PANDA_JOINTS, False)
    patiently(listener.connect, listener.close)
    end = time.monotonic() + 3.0
    while time.monotonic() < end:
        sample = patient_read(listener)
    after = [patient_read(listener) for _ in range(200)]
    assert np.abs(np.median([s.dq for s in after], axis=0)).max() < 0.05
    assert np.abs(after[-1].q - sample.q).max() < 0.05
    second = Ros2Arm(address, PANDA_JOINTS, True)  # it holds: nobody else may command yet
    with pytest.raises(DriverError, match="somebody else publishes"):
        second.connect()
    listener.close()


@pytest.mark.alone
def test_bad_numbers_are_left_out_and_silence_ends_the_run():
    faults = ("--fault", "silence@0.5", "--fault", "nan=0.02", "--fault", "jump=0.02")
    with ros2_arm(*faults) as address, connected(address) as arm:
        refused = {}
        while not {"not_finite", "jump"} <= refused.keys():
            sample = patient_read(arm)
            assert np.isfinite(sample.q).all()
            refused = arm.intake.refused
        assert any("none (NaN)" in note for note in arm.intake.notes)
        said, end = "", time.monotonic() + 60.0
        while "has been silent" not in said and time.monotonic() < end:
            with pytest.raises(DriverError) as caught:
                push(arm, 0.0, 30_000)
            said = str(caught.value)  # beside busy processes: that no command came
            arm.stop()
        assert "/joint_states has been silent for" in said


@pytest.mark.alone
def test_without_limits_nothing_moves():
    with ros2_arm("--no-description", "--every", "4") as address:
        arm = Ros2Arm(address, PANDA_JOINTS, True)
        with pytest.raises(DriverError, match=r"no largest torque is known .*say effort=87"):
            arm.connect()
        told = Ros2Arm(address + "&effort=87,87,87,87,12,12,12", PANDA_JOINTS, True)
        with pytest.raises(DriverError, match="at 250 Hz an arm cannot be held by torques"):
            told.connect()
        listener = Ros2Arm(address, PANDA_JOINTS, False)
        patiently(listener.connect, listener.close)
        assert listener.period_ns == 4_000_000 and listener.read().q.shape == (7,)
        listener.close()


def test_nobody_is_there():
    arm = Ros2Arm(f"ros2:///joint_states?local=1&domain={free_domain()}", PANDA_JOINTS, False)
    with pytest.raises(DriverError, match="that are published: nothing"):
        arm.connect()
