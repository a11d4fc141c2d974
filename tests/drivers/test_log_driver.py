"""A recording obeys the driver's protocol."""

import numpy as np
import pytest

from drivers.files.log import LogArm
from drivers.interface import DriverError, EndOfStream
from tests.helpers.mcap_tools import JOINTS, LINKS, START_NS, STEP_NS, record, samples

# What every driver does (start, stop, commands, the end) is in `test_every_driver`.


@pytest.fixture
def path(tmp_path):
    return record(tmp_path / "a.mcap", samples(20, links=True))


def test_it_is_and_gives_what_was_recorded_and_ends(path):
    arm = LogArm(path)
    assert (arm.joint_names, arm.link_names) == (JOINTS, LINKS)
    assert arm.period_ns == STEP_NS and not arm.paced
    arm.connect()
    for expected in samples(20, links=True):
        sample = arm.read()
        assert sample.stamp_ns == expected.stamp_ns
        for name in ("q", "dq", "tau"):
            assert np.array_equal(getattr(sample, name), getattr(expected, name))
        assert np.array_equal(sample.links.twist, expected.links.twist)
        assert np.array_equal(sample.links.accel, expected.links.accel)
    for _ in range(2):
        with pytest.raises(EndOfStream, match="ends after 20 samples"):
            arm.read()


def test_it_starts_from_the_beginning_and_takes_no_commands(path):
    arm = LogArm(path)
    with pytest.raises(DriverError, match="not connected"):
        arm.read()
    for _ in range(2):
        arm.connect()
        assert arm.read().stamp_ns == START_NS
        with pytest.raises(DriverError, match="takes no torque"):
            arm.command(np.zeros(3))
        arm.close()


def test_joints_can_be_chosen(path):
    arm = LogArm(path, ["wrist", "elbow"])
    arm.connect()
    expected = samples(20, links=True)[0]
    sample = arm.read()
    assert np.array_equal(sample.q, expected.q[[2, 1]])
    assert np.array_equal(sample.links.twist, expected.links.twist[[2, 1]])
    assert arm.link_names == ("hand", "lower")
    with pytest.raises(DriverError, match="no joint knee; have"):
        LogArm(path, ["knee"])


def test_a_sample_without_link_motion_says_so(tmp_path):
    items = samples(10)
    arm = LogArm(record(tmp_path / "b.mcap", items))
    arm.connect()
    assert arm.link_names == ()
    assert arm.read().links is None
