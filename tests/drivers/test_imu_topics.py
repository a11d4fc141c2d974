"""Imu topics and link motion with stamps of their own, read for discovery."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from mcap_ros2.writer import Writer as RosWriter

from adapter.cli import main
from drivers.files.mcap import read_log
from drivers.files.mcap.links import Carrier
from drivers.files.messages import JointStateEncoder, MotionEncoder
from drivers.files.ros_types import ACCEL_STAMPED, IMU, JOINT_STATE, TWIST_STAMPED, schemas
from tests.helpers.mcap_tools import JOINTS, LINKS, START_NS
from tests.helpers.ros_messages import UNMEASURED, header, imu


@pytest.mark.parametrize("sensor_hz", [200.0, 1000.0, 987.0, 4000.0])
def test_what_is_carried_is_true_and_keeps_its_noise(sensor_hz: float) -> None:
    rng = np.random.default_rng(5)
    joint_s = np.arange(4000) / 1000
    own_s = np.arange(0.00037, 4.0, 1 / sensor_hz)
    own_s = own_s[(own_s < 1.5) | (own_s > 1.8)]

    def motion(t: np.ndarray) -> np.ndarray:
        return np.stack([np.sin(9 * t + c) for c in range(3)], axis=1)

    carrier = Carrier((1e9 * joint_s).astype(np.int64), Path("a"), [])
    own_ns = (1e9 * own_s).astype(np.int64)
    clean = carrier.carry("x", own_ns, motion(own_s))
    noise = carrier.carry("x", own_ns, rng.normal(size=(len(own_s), 3)))
    assert clean is not None and noise is not None
    heard = np.isfinite(clean).all(axis=1)
    assert heard.sum() >= 0.9 * 3.7 * min(1000, sensor_hz)
    assert not heard[(joint_s > 1.502) & (joint_s < 1.798)].any()
    assert np.abs(clean - motion(joint_s))[heard].max() < 1e-4
    fine = max(1.0, sensor_hz / 1000)
    variance = np.mean(noise[heard] ** 2)
    assert 0.9 / fine < variance < 1.2 / fine
    steps = np.diff(noise[heard], n=3, axis=0)  # what discovery takes the noise from
    assert np.mean(steps**2) / 20 == pytest.approx(variance, rel=0.2)


def _file(path: Path, topics: Sequence[tuple[str, str, list[tuple[int, bytes]]]]) -> Path:
    """Messages (stamp, payload) of (topic, schema), and joint states at 1 kHz for a second."""
    encoder = JointStateEncoder(JOINTS, "", ("position", "velocity"))
    states = []
    for k in range(1000):
        at, phase = START_NS + 1_000_000 * k, 0.005 * k + np.arange(3)
        states.append((at, encoder.encode(at, np.sin(phase), 5 * np.cos(phase), phase)))
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="somebody else")
        for topic, schema, messages in [("/joint_states", JOINT_STATE, states), *topics]:
            number = writer.register_schema(schema, "ros2msg", schemas()[schema].encode())
            channel = writer.register_channel(topic, "cdr", number)
            for at, data in messages:
                writer.add_message(channel, at, data, at)
        writer.finish()
    return path


def _raw(stamp_ns: int, frame: str, numbers: np.ndarray) -> bytes:
    """An Imu of 37 numbers, laid out by hand."""
    text = frame.encode() + b"\0"
    head = np.array([*divmod(stamp_ns, 10**9), len(text)], "<i4").tobytes() + text
    return b"\0\1\0\0" + head + bytes(-len(head) % 8) + numbers.astype("<f8").tobytes()


def _stream(
    frame: str, *, seed: int = 0, shift_ns: int = 300_000, period_ns: int = 5_000_000
) -> list[tuple[int, bytes]]:
    rng = np.random.default_rng(seed)
    out = []
    for at in range(START_NS + shift_ns, START_NS + shift_ns + 10**9, period_ns):
        numbers = np.zeros(37)
        numbers[13:16], numbers[25:28] = rng.normal(size=3), [0.1, 0.2, 9.8]
        out.append((at, _raw(at, frame, numbers)))
    return out


def _changed(messages: list[tuple[int, bytes]], number: int, value: float) -> list:
    """All messages with one of their 37 numbers changed."""
    at = number - 37
    return [
        (t, d[: 8 * at] + np.float64(value).tobytes() + d[8 * at + 8 or None :])
        for t, d in messages
    ]


def test_what_a_sensor_does_not_measure_is_not_a_number(tmp_path) -> None:
    streams = [
        ("/a", IMU, _changed(_stream("one"), 28, -1.0)),
        ("/b", IMU, _stream("two", seed=1)),
        ("/c", IMU, _changed(_stream("three", seed=2), 16, -1.0)),
        ("/b_again", IMU, _stream("two_raw", seed=1)),
        ("/d", IMU, _changed(_stream("four", seed=3), 27, 0.9)),
    ]
    log = read_log(_file(tmp_path / "a.mcap", streams), beside="sensors")
    assert log.link_names == ("one", "two", "four")
    heard = np.isfinite(log.accels[:, :, 0]).sum(axis=0)
    assert heard.tolist() == [0, 200, 200] and np.isnan(log.accels[:, :, 3:]).all()
    assert np.isfinite(log.twists[:, :, 5]).sum(axis=0).tolist() == [200] * 3
    told = " ".join(log.warnings)
    assert "/c: measures no angular velocity" in told
    assert "/b_again holds the sensor of /b again" in told
    assert "/d: accelerations are mostly about 0.9" in told
    assert "one, two, four: 200 Hz, carried" in told


def test_covariances_lie_where_other_tools_write_them(tmp_path) -> None:
    path, ones = tmp_path / "a.mcap", np.ones(3)
    with path.open("wb") as file:
        writer = RosWriter(file)
        states = writer.register_msgdef(JOINT_STATE, schemas()[JOINT_STATE])
        sensors = writer.register_msgdef(IMU, schemas()[IMU])
        for at in range(START_NS, START_NS + 10**8, 10**7):
            state = {"header": header(at, ""), "name": ["j"], "position": [1e-9 * at]}
            writer.write_message("/joint_states", states, state, at)
            for name in ("orientation", "angular_velocity", "linear_acceleration"):
                message = imu(at, name, 2 * ones, 5.5 * ones, **{f"{name}_covariance": UNMEASURED})
                writer.write_message(f"/{name}", sensors, message, at)
        writer.finish()
    log = read_log(path, beside="sensors")
    assert log.link_names == ("orientation", "linear_acceleration")
    assert np.array_equal(log.twists[:, :, 3:], np.full((10, 2, 3), 2.0))
    assert np.array_equal(log.accels[:, 0, :3], np.full((10, 3), 5.5))
    assert np.isnan(log.accels[:, 1]).all()


def test_two_sensors_on_a_topic_and_a_clock_of_its_own(tmp_path) -> None:
    mixed = sorted(_stream("left") + _stream("right", seed=1, shift_ns=900_000))
    late = _stream("late", shift_ns=10**11)
    streams = [("/imu", IMU, mixed), ("/late", IMU, late)]
    log = read_log(_file(tmp_path / "a.mcap", streams), beside="sensors")
    assert log.link_names == ("left", "right")
    assert any("do they share a clock" in line and "late" in line for line in log.warnings)
    streams = [("/imu", IMU, mixed), ("/more", IMU, _stream("left", seed=2))]
    log = read_log(_file(tmp_path / "b.mcap", streams), beside="sensors")
    assert log.link_names == ("/imu:left", "/imu:right", "/more")


@pytest.mark.parametrize(
    ("frames", "kept"),
    [
        (("imu_1", "imu_2", "imu_3"), LINKS),  # each its own
        (LINKS, LINKS),
        (("world", "world", "world"), ()),
        ((LINKS[0], LINKS[1], "world"), LINKS[:2]),
        (("world", LINKS[0], LINKS[1]), ()),  # that of the link before
        (("imu_1", "imu_2", ""), ()),
        (("", "", ""), LINKS),  # not told; topics tell the links
    ],
)
def test_frames_that_may_be_of_another_body_are_left_out(tmp_path, frames, kept) -> None:
    rng = np.random.default_rng(3)
    streams = []
    for link, frame in zip(LINKS, frames, strict=True):
        encoder = MotionEncoder(frame)
        stamps = range(START_NS + 400_000, START_NS + 10**9, 5_000_000)
        for prefix, schema in (("/link_twists/", TWIST_STAMPED), ("/link_accels/", ACCEL_STAMPED)):
            messages = [(at, encoder.encode(at, rng.normal(size=6))) for at in stamps]
            streams.append((prefix + link, schema, messages))
    log = read_log(_file(tmp_path / "a.mcap", streams), beside="sensors")
    links = [] if log.twists is None else np.isfinite(log.twists).any(axis=(0, 2)).tolist()
    heard = tuple(n for n, there in zip(log.link_names, links, strict=True) if there)
    assert heard == tuple(kept)
    assert len(kept) == 3 or any("not in that of the link" in line for line in log.warnings)


@pytest.mark.parametrize("seed", range(3))
def test_cut_and_garbled_messages_are_told_and_do_no_harm(tmp_path, seed: int) -> None:
    rng = np.random.default_rng(seed)
    streams, stamps = [], set()
    for k in range(3):
        messages = []
        for at, data in _stream(f"imu_{k}", seed=k):
            chance = rng.random()
            if chance < 0.1:
                data = data[: rng.integers(len(data))]
            elif chance < 0.2:
                broken = bytearray(data)
                for _ in range(rng.integers(1, 20)):
                    broken[rng.integers(len(broken))] = rng.integers(256)
                data = bytes(broken)
            stamps.add(at)
            messages.append((at, data))
        streams.append((f"/imu_{k}", IMU, messages))
    log = read_log(_file(tmp_path / "a.mcap", streams), beside="sensors")
    assert len(log.link_names) == 3 and any("unreadable" in line for line in log.warnings)
    heard = np.isfinite(log.twists[:, :, 3]).sum(axis=0)
    assert (heard > 150).all() and (heard < 200).all()
    assert np.nanmax(np.abs(log.twists)) < 250.0
    assert main(["discover", str(log.path)]) in (0, 2)
