"""Bags of ROS 1 and rosbag2, by the library `rosbags`, told like the records of an MCAP file.

A file is known by its first bytes, not by its name. What lies in a compressed file is unpacked
into a temporary folder, at most `GROWTH_LIMIT` times its size. Messages of ROS 1, in a bag or in
an MCAP file, become CDR; a FrankaState of ROS 1, whose fields differ between versions, becomes a
JointState by the definition that its bag or file carries.
"""

from __future__ import annotations

import gzip
import importlib
import re
import struct
import tempfile
import weakref
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.records import Channel, Schema

from drivers.files.bounded import CHUNK_LIMIT, GROWTH_LIMIT, read_text
from drivers.files.mcap.records import MAGIC, McapScan, Region, Scan
from drivers.files.mcap.series import PARSERS, schema_name
from drivers.files.ros import FRANKA_STATE, JOINT_STATE, JointStateEncoder
from drivers.interface import DriverError

_SQLITE, _ROS1 = b"SQLite format 3\0", b"#ROSBAG"
_PACKED: dict[bytes, Callable[[Any], Any]] = {
    b"\x28\xb5\x2f\xfd": lambda file: zstandard.ZstdDecompressor().stream_reader(file),
    b"\x1f\x8b": lambda file: gzip.GzipFile(fileobj=file),
}
_HEAD = struct.Struct("<HIQQ")  # of a message as MCAP has it: channel, sequence, two times
_OWN_SCHEMAS = 2**16  # beyond the numbers that a file can give its schemas
_TOGETHER = 4096  # messages of one region
_STEP = 2**20
METADATA = "metadata.yaml"  # beside the files of a rosbag2
_BY_MESSAGE = re.compile(r"compression_mode:\W*message", re.IGNORECASE)
_OF_BAGS = (".db3", ".bag", ".mcap")


def open_scan(path: Path) -> Scan:
    """The records of an MCAP file, a bag of ROS 1, or a rosbag2 (folder or one of its files).

    Raises:
        DriverError: it is none of these, or cannot be read; names what is there.
    """
    if path.is_dir():
        return _open_folder(path)
    try:
        with path.open("rb") as file:
            head = file.read(len(_SQLITE))
    except OSError as error:
        raise DriverError(f"{path}: cannot be read: {error.strerror}") from error
    if head == _SQLITE:
        return BagScan(path, ".db3")
    if head.startswith(_ROS1):
        return BagScan(path, ".bag")
    if any(head.startswith(magic) for magic in _PACKED):
        return _unpacked(path, head)
    return McapOfAnyRos(path)


def is_rosbag2(path: Path) -> bool:
    """Whether a folder is one recording of rosbag2."""
    return (path / METADATA).is_file()


def is_recording(path: Path) -> bool:
    """Whether a file is one by its first bytes, packed or not, or by its name, or a folder has one.

    A damaged recording is one, too. False of what cannot be opened.
    """
    if path.is_dir():
        return is_rosbag2(path) or any(p.suffix in _OF_BAGS for p in path.iterdir())
    try:
        with path.open("rb") as file:
            head = file.read(len(_SQLITE))
            unpack = next((f for magic, f in _PACKED.items() if head.startswith(magic)), None)
            if unpack is not None:
                file.seek(0)
                head = unpack(file).read(len(_SQLITE))
    except (OSError, EOFError, ValueError, zlib.error, zstandard.ZstdError):
        head = b""
    named = path.with_suffix("") if path.suffix in (".gz", ".zst", ".zstd") else path
    return head.startswith((_SQLITE, _ROS1, MAGIC)) or named.suffix in _OF_BAGS


def _open_folder(path: Path) -> Scan:
    mcap = sorted(path.glob("*.mcap"))
    if is_rosbag2(path) and (len(mcap) != 1 or _BY_MESSAGE.search(_described(path))):
        return BagScan(path, "")
    files = mcap or sorted(p for p in path.iterdir() if p.suffix in _OF_BAGS)
    if len(files) == 1:
        return open_scan(files[0])
    inside = ", ".join(p.name for p in files) or "no recording"
    raise DriverError(f"{path}: is a folder; name the file in it (has: {inside})")


def _described(path: Path) -> str:
    try:
        return read_text(path / METADATA)
    except (OSError, ValueError) as error:
        raise DriverError(f"{path / METADATA}: cannot be read: {error}") from error


def _unpacked(path: Path, head: bytes) -> Scan:
    """What lies in a compressed file; errors and warnings name the file itself."""
    folder = tempfile.TemporaryDirectory()
    try:
        scan = _scan_unpacked(path, head, Path(folder.name) / "unpacked")
    except BaseException:
        folder.cleanup()
        raise
    weakref.finalize(scan, folder.cleanup)
    return scan


def _scan_unpacked(path: Path, head: bytes, whole: Path) -> Scan:
    unpack = next(unpack for magic, unpack in _PACKED.items() if head.startswith(magic))
    left = GROWTH_LIMIT * path.stat().st_size + CHUNK_LIMIT
    with path.open("rb") as packed, whole.open("wb") as out:
        try:
            with unpack(packed) as stream:
                while left > 0 and (part := stream.read(_STEP)):
                    out.write(part)
                    left -= len(part)
        except (OSError, EOFError, ValueError, zstandard.ZstdError) as error:
            raise DriverError(f"{path}: cannot be unpacked: {error}") from error
    if left <= 0:
        raise DriverError(f"{path}: would grow more than {GROWTH_LIMIT} times; not read")
    try:
        scan = open_scan(whole)
    except DriverError as error:
        raise DriverError(str(error).replace(str(whole), str(path))) from error
    scan.path = path
    return scan


class BagScan(Scan):
    """One pass over a bag of ROS 1, or a folder or SQLite file of rosbag2."""

    def __init__(self, path: Path, kind: str) -> None:
        """Args: path: of the bag; kind: ".db3", ".bag", or "" for a folder of rosbag2."""
        super().__init__(path)
        self._whole, self._kind = path.resolve(), kind
        self._one = kind == ".bag"
        if kind and path.with_name(f"{path.name}-wal").exists():
            self.warnings.append(
                f"{path}: what lies in {path.name}-wal is not read (sqlite3 opens "
                "the file and writes it in)"
            )

    def regions(self) -> Iterator[Region]:
        """The messages of known types; others are counted in `passed`. Raises DriverError."""
        with tempfile.TemporaryDirectory() as folder:
            # Under a plain name: in the user's `?` and `#` would be read as parts of an address.
            link = Path(folder) / f"bag{self._kind}"
            link.symlink_to(self._whole)
            try:
                yield from self._messages(link)
            except Exception as error:  # rosbags' own, SQLite's, and those of damaged bytes
                said = " ".join(str(error).replace(str(link), "it").split())[:200]
                raise DriverError(
                    f"{self.path}: is a damaged or unfinished bag: {said or type(error).__name__}"
                    + (" (`rosbag reindex` may mend it)" if self._one else "")
                ) from error

    def _messages(self, link: Path) -> Iterator[Region]:
        name = "rosbags.rosbag1" if self._one else "rosbags.rosbag2"
        with importlib.import_module(name).Reader(link) as bag:
            self._note(bag.connections)
            chosen = [c for c in bag.connections if c.msgtype in PARSERS]
            for c in bag.connections:
                if c not in chosen:
                    self.passed[c.topic] = self.passed.get(c.topic, 0) + c.msgcount
            if chosen:
                convert = None
                if self._one:
                    convert = _to_cdr({c.msgtype: c.msgdef.data for c in chosen})
                yield from self._packed(bag.messages(chosen), convert)

    def _note(self, connections: list[Any]) -> None:
        for c in connections:
            kind = JOINT_STATE if self._one and c.msgtype == FRANKA_STATE else c.msgtype
            self.schemas[c.id] = Schema(c.id, b"", "ros2msg", kind)
            encoding = "cdr" if self._one else c.ext.serialization_format
            self.channels[c.id] = Channel(c.id, c.topic, encoding, {}, c.id)

    def _packed(
        self, messages: Iterator[Any], convert: Callable[[str, bytes], bytes] | None
    ) -> Iterator[Region]:
        data, starts, stops = bytearray(), [], []
        for number, (connection, time_ns, raw) in enumerate(messages):
            if convert is not None:
                raw = convert(connection.msgtype, raw)
            data += _HEAD.pack(connection.id, number % 2**32, time_ns, time_ns)
            starts.append(len(data))
            data += raw
            stops.append(len(data))
            if len(starts) == _TOGETHER:
                yield _region(data, starts, stops)
                data, starts, stops = bytearray(), [], []
        if starts:
            yield _region(data, starts, stops)


class McapOfAnyRos(McapScan):
    """One pass over an MCAP file; what ROS 1 serialized is told as CDR."""

    def __init__(self, path: Path) -> None:
        """Open the file. Raises DriverError where it cannot be an MCAP file."""
        super().__init__(path)
        self._from_ros1: dict[int, Callable[[bytes], bytes]] = {}  # by channel

    def regions(self) -> Iterator[Region]:
        """All complete messages, in the order of the file; damaged chunks are passed over."""
        for region in super().regions():
            numbers = np.unique(region.channel).tolist()
            # A file repeats its channels in each chunk, so their telling is put right each time.
            for number in numbers:
                self._tell_as_cdr(number)
            if any(number in self._from_ros1 for number in numbers):
                yield self._converted(region)
            else:
                yield region

    def _tell_as_cdr(self, number: int) -> None:
        channel = self.channels.get(number)
        schema = None if channel is None else self.schemas.get(channel.schema_id)
        if channel is None or schema is None or channel.message_encoding != "ros1":
            return
        kind = schema_name(self, channel)
        if kind not in PARSERS or schema.encoding != "ros1msg":
            return
        if number not in self._from_ros1:
            convert = self._converter(kind, schema)
            if convert is None:
                return
            self._from_ros1[number] = convert
        told = JOINT_STATE if kind == FRANKA_STATE else kind
        own = _OWN_SCHEMAS + number
        self.schemas[own] = Schema(own, b"", "ros2msg", told)
        self.channels[number] = Channel(number, channel.topic, "cdr", channel.metadata, own)

    def _converter(self, kind: str, schema: Schema) -> Callable[[bytes], bytes] | None:
        try:
            convert = _to_cdr({kind: schema.data.decode()})
        except Exception as error:  # of whatever kind rosbags' parser raises
            said = " ".join(str(error).split())[:200] or type(error).__name__
            self._warn(f"the definition of {schema.name} cannot be read: {said}")
            return None
        return lambda raw: convert(kind, raw)

    def _converted(self, region: Region) -> Region:
        data, starts, stops = bytearray(), [], []
        places = zip(region.start.tolist(), region.stop.tolist(), strict=True)
        for (start, stop), number in zip(places, region.channel.tolist(), strict=True):
            data += region.data[start - _HEAD.size : start].tobytes()
            starts.append(len(data))
            raw = region.data[start:stop].tobytes()
            convert = self._from_ros1.get(number)
            data += raw if convert is None else convert(raw)
            stops.append(len(data))
        return _region(data, starts, stops)


def _region(data: bytearray, starts: list[int], stops: list[int]) -> Region:
    return Region(np.frombuffer(data, np.uint8), np.array(starts), np.array(stops))


def _to_cdr(definitions: dict[str, str]) -> Callable[[str, bytes], bytes]:
    """What turns a message of ROS 1 into CDR; one that cannot be read becomes empty.

    Args:
        definitions: of each type, as a bag of ROS 1 has them.
    """
    typesys = importlib.import_module("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)  # whose headers have no `seq`
    for kind, text in definitions.items():
        found = typesys.get_types_from_msg(text, kind)
        store.register({k: v for k, v in found.items() if k not in store.fielddefs})
    encoders: dict[int, JointStateEncoder] = {}

    def convert(kind: str, raw: bytes) -> bytes:
        try:
            cdr = bytes(store.ros1_to_cdr(raw, kind))
        except Exception:  # of whatever kind; the message is then counted as unreadable
            return b""
        return _joint_state(store.deserialize_cdr(cdr, kind)) if kind == FRANKA_STATE else cdr

    def _joint_state(state: Any) -> bytes:
        n = len(state.q)
        encoder = encoders.setdefault(n, JointStateEncoder([f"joint{i + 1}" for i in range(n)]))
        stamp = state.header.stamp
        stamp_ns = stamp.sec * 1_000_000_000 + stamp.nanosec
        return encoder.encode(stamp_ns, state.q, state.dq, state.tau_J)

    return convert
