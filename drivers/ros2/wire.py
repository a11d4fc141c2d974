"""DDS as ROS 2 uses it: topic `rt/joint_states`, type `sensor_msgs::msg::dds_::JointState_`, XCDR1.

Types are made from the definitions in `drivers.files.ros_types`. DDS needs them for their names
and for what it tells others of them; the bytes themselves are ours: what is sent was encoded by
`drivers.files`, and what comes is handed out as it is. The library is Eclipse Cyclone DDS.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg

from drivers.files.ros_types import schemas
from drivers.interface import DriverError

LOCAL = """<CycloneDDS><Domain Id="any"><General><Interfaces>
<NetworkInterface name="lo" multicast="false"/></Interfaces><AllowMulticast>false</AllowMulticast>
</General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>64</MaxAutoParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers>
</Discovery></Domain></CycloneDDS>"""  # this machine only, without multicast
MOST_TAKEN, MOST_ENDS = 32, 4096


@dataclass(frozen=True)
class Found:
    """Somebody who publishes or listens: topic as ROS calls it, type, and who.

    Attributes:
        topic: with its slash; schema: package/msg/Name.
        key: of this end, unique on the network.
    """

    topic: str
    schema: str
    key: str


class Network:
    """A participant of a DDS domain.

    Args:
        domain: its number, ROS_DOMAIN_ID.
        local: on this machine only, without multicast; what CYCLONEDDS_URI says is not looked at.

    Attributes:
        participant: for what waits on it.

    Raises:
        DriverError: the library is not installed, or there is no such network.
    """

    def __init__(self, domain: int, local: bool) -> None:
        try:
            from cyclonedds import builtin
            from cyclonedds.core import DDSException
            from cyclonedds.domain import DomainParticipant
        except ImportError as error:
            raise DriverError(
                "DDS needs a package that is not installed: pip install 'panda-adapter[ros]'"
            ) from error
        try:
            if local:
                _domain_of_this_machine(domain)
            self.participant = DomainParticipant(domain)
            readers = builtin.BuiltinTopicDcpsPublication, builtin.BuiltinTopicDcpsSubscription
            self._seen = [builtin.BuiltinDataReader(self.participant, kind) for kind in readers]
        except DDSException as error:
            raise DriverError(
                f"no DDS in domain {domain}: {error.msg}; is the network up, is CYCLONEDDS_URI "
                f"right ({os.environ.get('CYCLONEDDS_URI') or 'not set'})?"
            ) from error

    def publishers(self) -> list[Found]:
        """All that publish, as far as discovery has come."""
        return self._look(0)

    def listeners(self) -> list[Found]:
        """All that listen."""
        return self._look(1)

    def _look(self, which: int) -> list[Found]:
        found = []
        for end in self._seen[which].read(MOST_ENDS):
            name, schema = ros_topic(end.topic_name), ros_schema(end.type_name)
            if name and end.sample_info.instance_state == 16:  # alive, see `InstanceState`
                found.append(Found(name, schema, str(end.key)))
        return found

    def subscribe(self, topic: str, schema: str, latched: bool = False) -> Subscription:
        """Listen to a topic of ROS; `latched` asks for what was said before."""
        return Subscription(self, topic, schema, latched)

    def publish(self, topic: str, schema: str, latched: bool = False) -> Publication:
        """Publish on a topic of ROS; `latched` keeps the last message for who comes later."""
        return Publication(self, topic, schema, latched)


@cache
def _domain_of_this_machine(domain: int) -> Any:
    """Its configuration, which a process may give a domain once; kept, since it ends with it."""
    from cyclonedds.domain import Domain

    return Domain(domain, LOCAL)


class Subscription:
    """Messages of one topic, as bytes."""

    def __init__(self, network: Network, topic: str, schema: str, latched: bool) -> None:
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        named = Topic(network.participant, dds_topic(topic), dds_type(schema))
        self.reader = DataReader(network.participant, named, qos=quality(latched, 1000))

    def take(self) -> list[bytes]:
        """What has come and was not taken yet, oldest first."""
        found = self.reader.take(MOST_TAKEN)
        return [sample.data for sample in found if isinstance(sample, Encoded)]


class Publication:
    """Sends encoded messages of one topic."""

    def __init__(self, network: Network, topic: str, schema: str, latched: bool) -> None:
        from cyclonedds.pub import DataWriter
        from cyclonedds.topic import Topic

        self._type = dds_type(schema)
        named = Topic(network.participant, dds_topic(topic), self._type)
        self._writer = DataWriter(network.participant, named, qos=quality(latched, 1))
        self._sample = self._type.__new__(self._type)  # its fields are never looked at

    def write(self, data: bytes) -> None:
        """Send a message: CDR with its encapsulation header."""
        self._sample.encoded = data
        self._writer.write(self._sample)

    @property
    def listeners(self) -> int:
        """How many listen to it."""
        return len(self._writer.get_matched_subscriptions())

    @property
    def key(self) -> str:
        """Of this end, as in `Found`."""
        return str(self._writer.guid)


class Encoded:
    """A message as it came: the library wants an object that it can give attributes."""

    def __init__(self, data: bytes) -> None:
        self.data = bytes(data)
        self.sample_info: Any = None


def quality(latched: bool, depth: int) -> Any:
    """Quality of service: reliable, and volatile as of ros2_control, or transient local."""
    from cyclonedds.core import Policy, Qos
    from cyclonedds.util import duration

    durability = Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile
    return Qos(
        Policy.Reliability.Reliable(duration(milliseconds=100)),
        durability,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )


def dds_topic(topic: str) -> str:
    """`rt/joint_states` of `/joint_states`."""
    return "rt/" + topic.lstrip("/")


def ros_topic(name: str) -> str:
    """`/joint_states` of `rt/joint_states`; empty for what is no topic of ROS."""
    return name[2:] if name.startswith("rt/") else ""


def ros_schema(name: str) -> str:
    """`sensor_msgs/msg/JointState` of `sensor_msgs::msg::dds_::JointState_`."""
    return name.replace("::dds_::", "::").replace("::", "/").removesuffix("_")


def described(found: Sequence[Found]) -> str:
    """Topics for people; `nothing` where there is none."""
    return ", ".join(sorted({x.topic for x in found})) or "nothing"


@cache
def dds_type(schema: str) -> Any:
    """The library's class for a message; its values go by as bytes."""
    made = _struct(schema, get_types_from_msg(schemas()[schema], schema))
    made.deserialize = classmethod(lambda cls, data, **how: Encoded(data))
    made.serialize = lambda self, **how: self.encoded
    return made


def _struct(name: str, known: Mapping[str, Any]) -> Any:
    """A class of the library for one of several messages, with those that it uses."""
    from cyclonedds.idl import make_idl_struct

    package, _, short = name.split("/")
    members = {field: _member(kind, known) for field, kind in known[name][1]}
    return make_idl_struct(f"{short}_", f"{package}.msg.dds_.{short}_", members)


def _member(kind: Any, known: Mapping[str, Any]) -> Any:
    from cyclonedds.idl import types

    node, inner = kind
    if node == Nodetype.NAME:
        return _struct(inner, known)
    if node == Nodetype.BASE:
        plain: dict[str, Any] = {"string": str, "bool": bool, "byte": types.uint8}
        return plain.get(inner[0]) or getattr(types, inner[0])
    item, size = inner
    one = _member(item, known)
    return types.array[one, size] if node == Nodetype.ARRAY else types.sequence[one]
