"""A recording as a driver; what every driver does is in `test_every_driver`."""

import numpy as np
import pytest

from drivers.files.log import LogArm
from drivers.interface import DriverError, EndOfStream
from tests.helpers.mcap_tools import JOINTS, LINKS, STEP_NS, record, samples


@pytest.mark.parametrize("order", [None, [2, 1]])
def test_it_gives_what_was_recorded_of_the_joints_asked_for_and_ends(tmp_path, order):
    path = record(tmp_path / "a.mcap", samples(20, links=True))
    chosen = np.array(order or range(3))
    arm = LogArm(path, order and [JOINTS[k] for k in order])
    assert arm.joint_names == tuple(JOINTS[k] for k in chosen)
    assert arm.link_names == tuple(LINKS[k] for k in chosen)
    assert arm.period_ns == STEP_NS and not arm.paced
    arm.connect()
    for expected in samples(20, links=True):
        sample = arm.read()
        assert sample.stamp_ns == expected.stamp_ns
        for name in ("q", "dq", "tau"):
            assert np.array_equal(getattr(sample, name), getattr(expected, name)[chosen])
        assert np.array_equal(sample.links.twist, expected.links.twist[chosen])
        assert np.array_equal(sample.links.accel, expected.links.accel[chosen])
    with pytest.raises(EndOfStream, match="ends after 20 samples"):
        arm.read()
    with pytest.raises(DriverError, match="takes no torque"):
        arm.command(np.zeros(3))
    with pytest.raises(DriverError, match="no joint knee; have"):
        LogArm(path, ["knee"])


def test_a_sample_without_link_motion_says_so(tmp_path):
    arm = LogArm(record(tmp_path / "b.mcap", samples(10)))
    arm.connect()
    assert arm.link_names == ()
    assert arm.read().links is None
