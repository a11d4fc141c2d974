"""Any ROS 2 message whose definition is known, from and to mappings of its fields.

For messages that come some ten times a second: the library `rosbags` builds what reads and writes
a type from its definition, and an encoding takes some 100 µs. What comes at an arm's own rate has
an encoder of its own here, which keeps the bytes that stay the same; what is read at that rate is
read by `drivers.files.ros`. Written is CDR (XCDR1) little endian.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

from drivers.files.ros import SECOND_NS, CdrError
from drivers.files.ros_types import IMU, JOINT_STATE, TF, TWIST_STAMPED, schemas
from drivers.interface import Array

Fields = Mapping[str, Any]
Build = Callable[[Any], Any]
_RUNS = ("position", "velocity", "effort")
# A stamp and a double no byte of which is 0: where they are put, a message differs from zeros.
_NO_ZERO_NS, _NO_ZERO = 0x01010101 * (SECOND_NS + 1), 7.748604185489348e-304


class Message(NamedTuple):
    """A message to be written or published.

    Attributes:
        topic: with its slash; schema: package/msg/Name.
        stamp_ns: when it holds, on the arm's clock.
        fields: of the message, all of them; or its bytes, encoded already.
        latched: said once and of use to whoever comes later (ROS: transient local).
    """

    topic: str
    schema: str
    stamp_ns: int
    fields: Any
    latched: bool = False


def header(stamp_ns: int, frame_id: str = "") -> dict[str, Any]:
    """Fields of a std_msgs/Header."""
    sec, nanosec = divmod(stamp_ns, SECOND_NS)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame_id}


def stamp_of(fields: Fields) -> int:
    """The stamp of a message that has a header, ns."""
    stamp = fields["header"]["stamp"]
    return int(stamp["sec"]) * SECOND_NS + int(stamp["nanosec"])


def encode(schema: str, fields: Fields | bytes) -> bytes:
    """CDR (little endian) of a message of `schemas`; every field has to be there.

    Bytes are taken as encoded.

    Raises:
        CdrError: a field is missing, of no use, or does not fit its type.
    """
    if isinstance(fields, bytes):
        return fields
    try:
        write, build = _writer(schema)
        return bytes(write(build(fields), schema))
    except Exception as error:  # KeyError of a missing field, struct.error, rosbags' own
        raise CdrError(f"{schema}: {type(error).__name__}: {error}") from error


def decode(schema: str, data: bytes, definition: str | None = None) -> dict[str, Any]:
    """Fields of a message; numbers in arrays come as NumPy arrays.

    Args:
        schema: its type, package/msg/Name.
        data: CDR with its encapsulation header.
        definition: as the recording has it; that of `schemas` where None.

    Raises:
        CdrError: it is no such message, or nobody says what the type is.
    """
    text = schemas().get(schema) if definition is None else definition
    if text is None:
        raise CdrError(f"no definition of {schema}; have: {', '.join(schemas())}")
    try:
        store = _store(schema, text)
        return dict(_plain(store, store.deserialize_cdr(data, schema)))
    except Exception as error:  # of whatever kind the library raises on damaged bytes
        raise CdrError(f"{schema}: {type(error).__name__}: {error}") from error


@cache
def _store(schema: str, definition: str) -> Typestore:
    """Reads and writes one type and all that it uses."""
    store = Typestore()
    store.register(get_types_from_msg(definition, schema))
    return store


@cache
def _writer(schema: str) -> tuple[Callable[[Any, str], Any], Build]:
    store = _store(schema, schemas()[schema])
    return store.serialize_cdr, _builder(store, schema)


def _builder(store: Typestore, name: str) -> Build:
    """What makes an object of rosbags' class from a message's fields."""
    make = store.types[name]
    parts = [(key, _part(store, kind)) for key, kind in store.fielddefs[name][1]]
    known = {key for key, _ in parts}

    def build(fields: Fields) -> Any:
        if len(fields) != len(parts):
            raise ValueError(f"{name} has the fields {sorted(known)}, got {sorted(fields)}")
        return make(**{key: part(fields[key]) for key, part in parts})

    return build


def _part(store: Typestore, kind: Any) -> Build:
    """What makes of a field's value what rosbags takes."""
    node, inner = kind
    if node == Nodetype.NAME:
        return _builder(store, inner)
    if node == Nodetype.BASE:
        return lambda value: value
    (item_node, item), _ = inner
    if item_node == Nodetype.NAME:
        build = _builder(store, item)
        return lambda values: [build(x) for x in values]
    if item[0] == "string":
        return list
    return lambda values: np.asarray(values, dtype=item[0])


def _plain(store: Typestore, value: Any) -> Any:
    """Mappings and lists of a message's objects; constants of a type are no fields."""
    if isinstance(value, list):
        return [_plain(store, x) for x in value]
    name = getattr(value, "__msgtype__", None)
    if name is None:
        return value
    return {key: _plain(store, getattr(value, key)) for key, _ in store.fielddefs[name][1]}


class _Encoder:
    """Encodes messages that differ in stamps and doubles alone, in some µs each.

    Args:
        schema: their type; fields_of: a message's fields, from its stamp, ns, and a number that
            stands for all doubles that differ.
    """

    def __init__(self, schema: str, fields_of: Callable[[int, float], Fields]) -> None:
        zeros, other = (
            np.frombuffer(encode(schema, fields_of(*varying)), np.uint8)
            for varying in ((0, 0.0), (_NO_ZERO_NS, _NO_ZERO))
        )
        edges = np.flatnonzero(np.diff(zeros != other)) + 1
        self._pieces = [piece.tobytes() for piece in np.split(zeros, edges)]
        ends = np.cumsum([0, *map(len, self._pieces[1::2])])
        self._parts = [slice(*pair) for pair in pairwise(ends.tolist())]

    def _filled(self, varying: bytes) -> bytes:
        """One message, of its stamps and doubles as they follow one another."""
        pieces = self._pieces.copy()
        pieces[1::2] = [varying[part] for part in self._parts]
        return b"".join(pieces)


class JointStateEncoder(_Encoder):
    """Encodes JointState messages of the same joints.

    Args:
        names: the joints, in the order of the arrays.
        frame_id: of the header.
        fields: which of position, velocity and effort the messages carry.
    """

    def __init__(
        self, names: Sequence[str], frame_id: str = "", fields: Sequence[str] = _RUNS
    ) -> None:
        self._shape = (len(names),)
        self._told = [(k, field) for k, field in enumerate(_RUNS) if field in fields]

        def message(stamp_ns: int, x: float) -> Fields:
            runs = {field: np.full(len(names) if field in fields else 0, x) for field in _RUNS}
            return {"header": header(stamp_ns, frame_id), "name": list(names), **runs}

        super().__init__(JOINT_STATE, message)

    def encode(self, stamp_ns: int, q: Array, dq: Array, tau: Array) -> bytes:
        """One message; arrays of absent fields are ignored. Raises CdrError on wrong shapes."""
        runs = q, dq, tau
        told = [_raw(runs[k], self._shape, name) for k, name in self._told]
        return self._filled(_stamp(stamp_ns) + b"".join(told))


class MotionEncoder(_Encoder):
    """Encodes TwistStamped or AccelStamped (same bytes) of one frame."""

    def __init__(self, frame_id: str) -> None:
        def message(stamp_ns: int, x: float) -> Fields:
            twist = {"linear": _vector(x), "angular": _vector(x)}
            return {"header": header(stamp_ns, frame_id), "twist": twist}

        super().__init__(TWIST_STAMPED, message)

    def encode(self, stamp_ns: int, vector: Array) -> bytes:
        """One message of a (6,) vector, linear part first. Raises CdrError on a wrong shape."""
        return self._filled(_stamp(stamp_ns) + _raw(vector, (6,), "vector"))


class ImuEncoder(MotionEncoder):
    """Encodes Imu of one frame, without an orientation, from [w; a] (6,)."""

    def __init__(self, frame_id: str) -> None:
        told, unknown = ("angular_velocity", "linear_acceleration"), np.zeros(9)

        def message(stamp_ns: int, x: float) -> Fields:
            return {
                "header": header(stamp_ns, frame_id),
                "orientation": {**_vector(0.0), "w": 1.0},
                "orientation_covariance": np.array([-1.0, *unknown[1:]]),  # nothing is known
                **{key: _vector(x) for key in told},
                **{f"{key}_covariance": unknown for key in told},
            }

        _Encoder.__init__(self, IMU, message)


class TransformsEncoder(_Encoder):
    """Encodes tf2_msgs/TFMessage of the same frames.

    Args:
        frames: (parent, child) of each transform.
    """

    def __init__(self, frames: Sequence[tuple[str, str]]) -> None:
        self._shape = len(frames), 7

        def message(stamp_ns: int, x: float) -> Fields:
            place = {"translation": _vector(x), "rotation": {**_vector(x), "w": x}}
            return {
                "transforms": [
                    {
                        "header": header(stamp_ns, parent),
                        "child_frame_id": child,
                        "transform": place,
                    }
                    for parent, child in frames
                ]
            }

        super().__init__(TF, message)

    def encode(self, stamp_ns: int, numbers: Array) -> bytes:
        """One message of rows (m, 7): x y z in m, quaternion x y z w.

        Raises CdrError on a wrong shape.
        """
        stamp, raw = _stamp(stamp_ns), _raw(numbers, self._shape, "transforms")
        rows = (stamp + raw[at : at + 56] for at in range(0, len(raw), 56))
        return self._filled(b"".join(rows))


def _vector(x: float) -> dict[str, float]:
    return dict.fromkeys("xyz", x)


def _stamp(stamp_ns: int) -> bytes:
    try:
        return struct.pack("<iI", *divmod(stamp_ns, SECOND_NS))
    except struct.error:
        told = f"stamp {stamp_ns} ns does not fit a ROS time (32 bit seconds)"
        raise CdrError(told) from None


def _raw(values: Array, shape: tuple[int, ...], what: str) -> bytes:
    table = np.asarray(values, dtype="<f8")
    if table.shape != shape:
        raise CdrError(f"{what} has shape {table.shape}, expected {shape}")
    return table.tobytes()
