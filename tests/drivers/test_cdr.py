"""The codec against mcap-ros2-support, an independent one that reads the schemas' text."""

import struct
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic

from drivers.files.messages import JointStateEncoder, MotionEncoder
from drivers.files.ros import CdrError, decode_many, parse_doubles, parse_joint_state
from drivers.files.ros_types import ACCEL_STAMPED, JOINT_STATE, TWIST_STAMPED, schemas

READ = {name: generate_dynamic(name, text)[name] for name, text in schemas().items()}
WRITE = {name: serialize_dynamic(name, text)[name] for name, text in schemas().items()}
FIELDS = ("position", "velocity", "effort")

texts = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=12)
doubles = st.floats(allow_nan=False)
stamps = st.integers(-(2**31) * 10**9, (2**31) * 10**9 - 1)


def header(stamp_ns: int, frame_id: str) -> SimpleNamespace:
    sec, nanosec = divmod(stamp_ns, 10**9)
    return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=nanosec), frame_id=frame_id)


def decoded(data, parse=parse_joint_state, runs=FIELDS) -> SimpleNamespace:
    """One message, read as a batch of one. Raises CdrError."""
    layout = parse(data)
    (block,), _ = decode_many(np.frombuffer(data, np.uint8)[None], parse)
    values = dict(zip(runs, (run[0] for run in block.values), strict=True))
    stamp_ns = int(block.stamp_ns[0])
    return SimpleNamespace(
        stamp_ns=stamp_ns, frame_id=layout.frame_id, names=layout.names, **values
    )


@given(
    stamps,
    texts,
    st.lists(texts, max_size=5),
    st.lists(doubles, min_size=5, max_size=5),
    st.sets(st.sampled_from(FIELDS)),
)
def test_joint_state_means_the_same_to_both(stamp_ns, frame_id, names, numbers, fields):
    values = np.array(numbers[: len(names)])
    data = JointStateEncoder(names, frame_id, tuple(fields)).encode(
        stamp_ns, values, values + 1, values + 2
    )
    theirs = READ[JOINT_STATE](data)
    assert theirs.header.stamp.sec * 10**9 + theirs.header.stamp.nanosec == stamp_ns
    assert theirs.header.frame_id == frame_id
    assert list(theirs.name) == names
    ours = decoded(data)
    assert (ours.stamp_ns, ours.frame_id, ours.names) == (stamp_ns, frame_id, tuple(names))
    for offset, field in enumerate(FIELDS):
        expected = list(values + offset) if field in fields else []
        assert list(getattr(theirs, field)) == expected
        assert list(getattr(ours, field)) == expected


@given(stamps, texts, st.lists(texts, max_size=4), *[st.lists(doubles, max_size=4) for _ in FIELDS])
def test_what_the_other_encodes_is_read(stamp_ns, frame_id, names, position, velocity, effort):
    message = SimpleNamespace(
        header=header(stamp_ns, frame_id),
        name=names,
        position=position,
        velocity=velocity,
        effort=effort,
    )
    ours = decoded(WRITE[JOINT_STATE](message))
    assert (ours.stamp_ns, ours.frame_id, ours.names) == (stamp_ns, frame_id, tuple(names))
    assert list(ours.position) == position
    assert list(ours.velocity) == velocity
    assert list(ours.effort) == effort


@pytest.mark.parametrize(("schema", "field"), [(TWIST_STAMPED, "twist"), (ACCEL_STAMPED, "accel")])
@given(stamps, texts, st.lists(doubles, min_size=6, max_size=6))
def test_motion_means_the_same_to_both(schema, field, stamp_ns, frame_id, numbers):
    data = MotionEncoder(frame_id).encode(stamp_ns, np.array(numbers))
    theirs = getattr(READ[schema](data), field)
    parts = [getattr(getattr(theirs, p), a) for p in ("linear", "angular") for a in "xyz"]
    assert parts == numbers
    linear, angular = (
        SimpleNamespace(**dict(zip("xyz", numbers[i : i + 3], strict=True))) for i in (0, 3)
    )
    body = SimpleNamespace(linear=linear, angular=angular)
    encoded = WRITE[schema](SimpleNamespace(header=header(stamp_ns, frame_id), **{field: body}))
    ours = decoded(encoded, partial(parse_doubles, number=6), ("vector",))
    assert (ours.stamp_ns, ours.frame_id, list(ours.vector)) == (stamp_ns, frame_id, numbers)


def plain(kind: int, order: str, align: int, names: list[str], values: list[float]) -> bytes:
    """A JointState in another kind of plain CDR, written out longhand."""
    body = struct.pack(order + "iI", 12, 34) + struct.pack(order + "I", 1) + b"\0"

    def padded(to: int) -> bytes:
        return body + bytes(-len(body) % to)

    body = padded(4) + struct.pack(order + "I", len(names))
    for name in names:
        body = padded(4) + struct.pack(order + "I", len(name) + 1) + name.encode() + b"\0"
    for _ in FIELDS:
        body = padded(4) + struct.pack(order + "I", len(values))
        body = padded(align) + struct.pack(f"{order}{len(values)}d", *values)
    return bytes((0, kind, 0, 0)) + body


@pytest.mark.parametrize(
    ("kind", "order", "align"), [(0, ">", 8), (1, "<", 8), (6, ">", 4), (7, "<", 4)]
)
@pytest.mark.parametrize("names", [["a"], ["ab", "cde"], ["joint", "x", "yz"]])
def test_either_byte_order_and_version(kind, order, align, names):
    values = [1.5 * i for i in range(len(names))]
    message = decoded(plain(kind, order, align, names, values))
    assert message.stamp_ns == 12 * 10**9 + 34
    assert message.names == tuple(names)
    assert list(message.effort) == values


@settings(max_examples=30)
@given(st.lists(st.tuples(st.sampled_from(["ab", "ba", "xy"]), stamps, doubles), min_size=1))
def test_many_at_once_equals_one_by_one(messages):
    data = [
        JointStateEncoder(names).encode(stamp, *(np.array([x, x + k]) for k in range(3)))
        for names, stamp, x in messages
    ]
    rows = np.stack([np.frombuffer(d, np.uint8) for d in data])
    blocks, bad = decode_many(rows, parse_joint_state)
    assert not bad
    assert len(blocks) == len({names for names, _, _ in messages})
    for block in blocks:
        for place, stamp, *values in zip(block.index, block.stamp_ns, *block.values, strict=True):
            single = decoded(data[place])
            assert single.stamp_ns == stamp
            assert single.names == block.layout.names
            assert np.array_equal(single.velocity, values[1])


@pytest.mark.parametrize("size", range(0, 100, 7))
def test_a_short_message_is_refused(size):
    data = JointStateEncoder(["a", "b"]).encode(1, np.zeros(2), np.zeros(2), np.zeros(2))
    with pytest.raises(CdrError):
        decoded(data[: min(size, len(data) - 1)])


def test_what_does_not_fit_is_refused():
    with pytest.raises(CdrError, match=r"position has shape \(3,\), expected \(2,\)"):
        JointStateEncoder(["a", "b"]).encode(1, np.zeros(3), np.zeros(2), np.zeros(2))
    with pytest.raises(CdrError, match="32 bit"):
        MotionEncoder("a").encode(2**63, np.zeros(6))
    with pytest.raises(CdrError, match="not plain CDR"):
        decoded(b"\x00\x03\x00\x00" + bytes(40))
