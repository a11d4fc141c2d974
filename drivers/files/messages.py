"""Any ROS 2 message whose definition is known, from and to mappings of its fields.

For messages that come some ten times a second: the library `rosbags` builds what reads and writes
a type from its definition, and an encoding takes some 100 µs. What comes at an arm's own rate has
encoders of its own in `drivers.files.ros`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

from drivers.files.ros import SECOND_NS, CdrError
from drivers.files.ros_types import SCHEMAS

Fields = Mapping[str, Any]
Build = Callable[[Any], Any]


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
    """CDR (little endian) of a message of `SCHEMAS`; every field has to be there.

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
        definition: as the recording has it; that of `SCHEMAS` where None.

    Raises:
        CdrError: it is no such message, or nobody says what the type is.
    """
    text = SCHEMAS.get(schema) if definition is None else definition
    if text is None:
        raise CdrError(f"no definition of {schema}; have: {', '.join(SCHEMAS)}")
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
    store = _store(schema, SCHEMAS[schema])
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
