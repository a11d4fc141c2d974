"""Messages of any type: public definitions are the public ones, and values survive both ways."""

from pathlib import Path

import numpy as np
import pytest
from mcap_ros2._dynamic import generate_dynamic
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from drivers.files.estimates import EstimateNames, estimate_fields, estimate_values
from drivers.files.mcap import McapWriter, read_estimates, read_log, read_messages
from drivers.files.messages import Message, TransformsEncoder, decode, encode, header
from drivers.files.ros import CdrError
from drivers.files.ros_types import DIAGNOSTICS, ESTIMATE, STRING, TF, schemas
from tests.helpers.mcap_tools import START_NS, samples
from tests.helpers.ros_messages import assert_read_by_everybody, same

NAMES = EstimateNames(("shoulder", "elbow", "wrist"), ("upper", "lower"), ("coulomb_friction",))


def an_estimate(seed: int = 0) -> dict:
    rng = np.random.default_rng(seed)
    shapes = {"lambda": (3, 6), "lambda_std": (3, 6), "offset": (3, 6), "theta": (2, 10)}
    shapes |= {"theta_std": (2, 10)} | {
        "effects": (1, 3),
        "effects_std": (1, 3),
        "effect_shapes": (1, 3),
    }
    values = {key: rng.normal(size=shape) for key, shape in (shapes | {"torque_std": (3,)}).items()}
    values["lambda_std"][1, 2] = np.nan
    flags = {"learned": 2**40, "lambda_source": "gemessen ✓"}
    return values | flags | {"lambda_converged": True, "theta_converged": False}


@pytest.mark.parametrize("name", [x for x in schemas() if not x.startswith("panda_adapter_msgs")])
def test_definitions_are_those_of_ros_2(name):
    """Every message in the text, nested ones too, as rosbags knows them of ROS 2 Humble."""
    known = get_typestore(Stores.ROS2_HUMBLE).fielddefs
    for found, (_, fields) in get_types_from_msg(schemas()[name], name).items():
        assert fields == known[found][1], found


def test_an_estimate_comes_back():
    values = an_estimate()
    fields = estimate_fields(7_000_000_001, NAMES, values)
    data = encode(ESTIMATE, fields)
    theirs = generate_dynamic(ESTIMATE, schemas()[ESTIMATE])[ESTIMATE](data)
    assert theirs.joints[2].value.px == values["lambda"][2, 3]
    assert theirs.bodies[1].std.izz == values["theta_std"][1, 9]
    assert (theirs.effects[1].effect, theirs.effects[1].joint) == ("coulomb_friction", "elbow")
    found = estimate_values(decode(ESTIMATE, data))
    assert found["stamp_ns"] == 7_000_000_001 and found["body_names"] == NAMES.bodies
    assert all(same(found[key], value) for key, value in values.items())


def test_transforms_are_encoded_as_by_the_library():
    frames = [("world", "a"), ("a", "längeres/glied"), ("a", "")]
    rows = np.random.default_rng(1).normal(size=(3, 7))
    data = TransformsEncoder(frames).encode(3 * 10**9 + 5, rows)
    found = decode(TF, data)
    assert encode(TF, found) == data
    for (parent, child), row, told in zip(frames, rows, found["transforms"], strict=True):
        assert told["header"] == header(3 * 10**9 + 5, parent) and told["child_frame_id"] == child
        parts = {**told["transform"]["translation"]}, told["transform"]["rotation"]
        assert [*parts[0].values(), *parts[1].values()] == row.tolist()


def test_what_does_not_fit_is_refused():
    with pytest.raises(CdrError, match="has the fields"):
        encode(STRING, {"data": "", "more": 1})
    with pytest.raises(CdrError, match="KeyError"):
        encode(STRING, {"dat": ""})
    with pytest.raises(CdrError, match="no definition of"):
        decode("a_msgs/msg/B", b"")
    with pytest.raises(CdrError):
        decode(DIAGNOSTICS, b"\0\1\0\0" + b"\xff" * 40)


def test_a_recording_of_them_is_read_by_everybody(tmp_path):
    path = tmp_path / "a.mcap"
    with McapWriter(path, ("shoulder", "elbow", "wrist")) as writer:
        for k, sample in enumerate(samples(5)):
            writer.write(sample)
            writer.write_command(sample.stamp_ns, sample.tau)
            fields = estimate_fields(sample.stamp_ns, NAMES, an_estimate(k))
            writer.write_message(Message("/estimates", ESTIMATE, sample.stamp_ns, fields))
        text = Message("/robot_description", STRING, START_NS, {"data": "<robot/>"}, latched=True)
        writer.write_message(text)
    topics = {"/joint_states", "/joint_commands", "/estimates", "/robot_description"}
    found = assert_read_by_everybody(path, topics)
    for topic, messages in found.items():
        ours = list(read_messages(path, topic))
        assert len(ours) == len(messages)
        for mine, (at, theirs) in zip(ours, messages, strict=True):
            assert mine.stamp_ns == at and same(mine.fields, theirs)
    estimates = list(read_estimates(path))
    assert same(estimates[3]["theta"], an_estimate(3)["theta"])
    assert read_log(path).topics["/estimates"].schema == ESTIMATE


def test_the_recording_of_the_repository_is_read_by_everybody():
    (path,) = Path(__file__).parents[2].glob("recordings/*.mcap")
    assert_read_by_everybody(path, {"/joint_states", "/joint_commands", "/estimates"})
    last = list(read_estimates(path))[-1]
    assert last["lambda_converged"] and last["joint_names"][0] == "panda_joint1"
