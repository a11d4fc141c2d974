"""Topics of ROS 2 beside a run, heard by another participant over DDS on the loopback interface."""

import time
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cyclonedds", reason="pip install 'panda-adapter[ros]'")

from adapter.cli.publishing import Publisher, publisher_job, together
from adapter.model.robots import documented
from adapter.realtime.run_messages import ShownArm
from adapter.realtime.showing import DisplayJob, View
from adapter.realtime.snapshot import ExternalTorque
from adapter.signals.records import StateLayout
from drivers.files.estimates import estimate_values
from drivers.files.messages import decode
from drivers.files.ros_types import ESTIMATE, FLOAT64_MULTI_ARRAY, TF, WRENCH_STAMPED
from drivers.ros2.settings import parse
from drivers.ros2.wire import Network
from tests.helpers.hardware_rigs import free_domain
from tests.helpers.live_learners import nothing_known

STAMP_NS = 1_700_000_000_123_456_789


def seen(model) -> View:
    """A look at a run that has learned something."""
    layout = StateLayout(model.tree.n)
    records = np.zeros((2, layout.size))
    records[:, 0].view(np.int64)[:] = STAMP_NS - 1, STAMP_NS
    records[1, layout.q] = np.linspace(-1, 1, model.tree.n)
    known = nothing_known(model.tree.n, model.tree.bodies, 1)
    snapshot = replace(known, lam=model.lam, theta=model.theta, stamp_ns=STAMP_NS, version=3)
    nan = np.full(7, np.nan)
    push = ExternalTorque(nan, nan, np.arange(6.0), nan[:6], None, True, STAMP_NS, version=1)
    news = {"findings": [], "load": {"m": 0.75, "m_std": 0.01}}
    return View(2, 0, 1.0, snapshot, False, records, push, news)


def test_what_is_published_is_heard():
    model, address = documented("panda"), f"ros2:///a?local=1&domain={free_domain()}"
    settings = parse(address)
    listener = Network(settings.domain, settings.local)
    wanted = {
        "/panda_adapter/estimates": ESTIMATE,
        "/panda_adapter/theta": FLOAT64_MULTI_ARRAY,
        "/panda_adapter/load": FLOAT64_MULTI_ARRAY,
        "/panda_adapter/external_wrench": WRENCH_STAMPED,
        "/tf": TF,
    }
    subscriptions = {topic: listener.subscribe(topic, kind) for topic, kind in wanted.items()}
    publisher = Publisher(settings, ShownArm.of(model), ("viscous_friction",))
    publisher(seen(model))  # nobody is discovered yet
    found, end = {}, time.monotonic() + 30.0
    while found.keys() < wanted.keys() and time.monotonic() < end:
        again = seen(model)
        version = int(time.monotonic() * 1000)
        load = {"m": 0.75, "m_std": 1e-6 * version}
        publisher(
            replace(
                again,
                snapshot=replace(again.snapshot, version=version),
                push=replace(again.push, version=version),
                news={"findings": [], "load": load},
            )
        )
        time.sleep(0.05)
        for topic, subscription in subscriptions.items():
            for data in subscription.take():
                found[topic] = decode(wanted[topic], data)
    assert found.keys() == wanted.keys()
    estimate = estimate_values(found["/panda_adapter/estimates"])
    assert estimate["stamp_ns"] == STAMP_NS and estimate["effect_names"] == ("viscous_friction",)
    assert np.array_equal(estimate["theta"], model.theta)
    theta = found["/panda_adapter/theta"]
    rows, columns = theta["layout"]["dim"]
    assert rows["label"].split(",") == list(model.tree.body_names) and columns["size"] == 10
    assert np.array_equal(theta["data"].reshape(rows["size"], -1), model.theta)
    assert found["/panda_adapter/load"]["data"][0] == 0.75
    frame = found["/panda_adapter/external_wrench"]["header"]["frame_id"]
    assert frame == "learned/panda_link7"
    frames = {x["child_frame_id"] for x in found["/tf"]["transforms"]}
    assert {"documented/panda_link7", "learned/panda_link7"} <= frames
    late = listener.subscribe("/tf_static", TF, latched=True)  # said once, before
    while not (told := late.take()) and time.monotonic() < end:
        time.sleep(0.05)
    children = {x["child_frame_id"] for x in decode(TF, told[0])["transforms"]}
    assert "documented/panda_link0" in children


def test_displays_share_a_process():
    notes: list = []
    one, other = (DisplayJob(lambda: notes.append, period_s=x) for x in (0.5, 0.1))
    both = together([one, None, other])
    assert both.period_s == 0.1 and together([None, one]) is one and together([None]) is None
    both.make()("a view")
    assert notes == ["a view", "a view"]


def test_only_an_arm_on_dds_has_topics():
    assert publisher_job("fci://172.16.0.2", documented("panda"), ()) is None
    assert publisher_job("ros2:///joint_states", documented("panda"), ()) is not None
