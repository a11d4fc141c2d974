"""Bags of ROS 1 and rosbag2, by the library `rosbags`, told like the records of an MCAP file.

A file is known by its first bytes, not by its name. What lies in a compressed file is unpacked
into a temporary folder; files, chunks and messages are unpacked here, in steps, because `rosbags`
takes what a few bytes make of whatever size. A bag makes at most `GROWTH_LIMIT` times its size, a
chunk or message of it at most `CHUNK_LIMIT`. Messages of ROS 1, in a bag or in
an MCAP file, become CDR; a FrankaState of ROS 1, whose fields differ between versions, becomes a
JointState by the definition that its bag or file carries.
"""

from __future__ import annotations

import bz2
import gzip
import importlib
import sqlite3
import struct
import tempfile
import weakref
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from io import BytesIO
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import zstandard
from mcap.records import Channel, Schema
from numpy.typing import NDArray

from drivers.files import names
from drivers.files.bounded import CHUNK_LIMIT, GROWTH_LIMIT, read_text
from drivers.files.mcap.records import MAGIC, McapScan, Region, Scan
from drivers.files.mcap.series import PARSERS, schema_name
from drivers.files.ros_types import FRANKA_STATE, JOINT_STATE
from drivers.interface import DriverError

_SQLITE, _ROS1, _ZSTD = b"SQLite format 3\0", b"#ROSBAG", b"\x28\xb5\x2f\xfd"
_PACKED: dict[bytes, Callable[[Any], Any]] = {
    _ZSTD: lambda file: zstandard.ZstdDecompressor().stream_reader(file),
    b"\x1f\x8b": lambda file: gzip.GzipFile(fileobj=file),
}
_HEAD = struct.Struct("<HIQQ")  # of a message as MCAP has it: channel, sequence, two times
_STEP = 2**20
_REGION_BYTES = 2**24  # beyond them a region ends
_COMPUTED = """
SELECT name FROM sqlite_master WHERE type = 'view' OR sql LIKE 'CREATE VIRTUAL%'
UNION ALL SELECT t.name || '.' || x.name FROM sqlite_master t, pragma_table_xinfo(t.name) x
WHERE t.type = 'table' AND x.hidden <> 0"""
_QOS = "offered_qos_profiles"
_FILES = "relative_file_paths"
_METADATA_LIMIT = 2**20  # bytes; a topic has some hundred


def open_scan(path: Path) -> Scan:
    """The records of an MCAP file, a bag of ROS 1, or a rosbag2 (folder or one of its files).

    Raises:
        DriverError: it is none of these, or cannot be read; names what is there.
    """
    if path.is_dir() and names.is_recording(path):
        return FolderScan(path)
    if path.is_dir():
        files = sorted(p for p in path.iterdir() if p.suffix in names.RECORDINGS)
        if len(files) == 1:
            return open_scan(files[0])
        inside = ", ".join(p.name for p in files) or "no recording"
        raise DriverError(f"{path}: is a folder; name the file in it (has: {inside})")
    try:
        with path.open("rb") as file:
            head = file.read(len(_SQLITE))
    except OSError as error:
        raise DriverError(f"{path}: cannot be read: {error.strerror}") from error
    if head == _SQLITE:
        return BagScan(path, ".db3")
    if head.startswith(_ROS1):
        return BagScan(path, ".bag")
    unpack = _unpacker(head)
    return McapOfAnyRos(path) if unpack is None else _unpacked(path, unpack)


def _unpacker(head: bytes) -> Callable[[Any], Any] | None:
    """What unpacks a file that begins so; None where it is not packed."""
    return next((unpack for magic, unpack in _PACKED.items() if head.startswith(magic)), None)


def is_recording(path: Path) -> bool:
    """Whether a file is one by its first bytes, packed or not, or by its name, or a folder has one.

    A damaged recording is one, too. False of what cannot be opened.
    """
    if path.is_dir():
        return names.is_recording(path) or any(p.suffix in names.RECORDINGS for p in path.iterdir())
    try:
        with path.open("rb") as file:
            head = file.read(len(_SQLITE))
            unpack = _unpacker(head)
            if unpack is not None:
                file.seek(0)
                head = unpack(file).read(len(_SQLITE))
    except (OSError, EOFError, ValueError, zlib.error, zstandard.ZstdError):
        head = b""
    return head.startswith((_SQLITE, _ROS1, MAGIC)) or names.is_recording(path)


def _files_of(folder: Path) -> list[Path]:
    """The files of a rosbag2, in their order. Raises DriverError where one is not there."""
    about = folder / names.METADATA
    try:
        text = read_text(about, _METADATA_LIMIT)
        # Composed and not constructed: a few merged mappings would fill the memory.
        root = importlib.import_module("ruamel.yaml").YAML(typ="safe").compose(text)
    except Exception as error:  # of whatever kind the parser raises
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise DriverError(f"{about}: cannot be read: {said}") from error
    try:
        told = {k.value: v for k, v in root.value}["rosbag2_bagfile_information"]
        listed = {k.value: v for k, v in told.value}[_FILES]
        inside = [PurePath(x.value).name for x in listed.value]
    except (AttributeError, TypeError, ValueError, KeyError) as error:
        raise DriverError(f"{about}: has no list of files ({_FILES})") from error
    files = [folder / name for name in dict.fromkeys(inside)]
    for file in files:
        if not file.is_file():
            raise DriverError(f"{about}: names the file {file.name}, which is not there")
    if not files:
        raise DriverError(f"{about}: names no file")
    return files


class _Growth:
    """What a file may still make of its bytes, by one pass over it.

    Args:
        path: of the file, for sentences; stored: its bytes, as they came.
    """

    def __init__(self, path: Path, stored: int) -> None:
        self._path, self._left = path, GROWTH_LIMIT * stored + CHUNK_LIMIT

    def refuse(self, why: str) -> None:
        """Raises DriverError: no recorder makes such a file."""
        raise DriverError(f"{self._path}: {why}; not read")

    def spend(self, size: int) -> None:
        """Count bytes that were made. Raises DriverError."""
        self._left -= size
        if self._left < 0:
            self.refuse(f"would grow more than {GROWTH_LIMIT} times")

    def message(self, raw: object) -> bytes:
        """A message, unpacked where packed: CDR never begins like zstd. Raises DriverError."""
        if not isinstance(raw, bytes):  # a database holds anything anywhere
            raw = b""  # counted as unreadable
        if raw[: len(_ZSTD)] == _ZSTD:
            try:
                raw = self.all_of(zstandard.ZstdDecompressor().stream_reader(raw))
            except zstandard.ZstdError:
                raw = b""
        self.spend(len(raw))
        return raw

    def all_of(self, stream: Any) -> bytes:
        """All that a chunk or message makes. Raises DriverError."""
        parts, size = [], 0
        while part := stream.read(_STEP):
            parts.append(part)
            size += len(part)
            if size > CHUNK_LIMIT:
                self.refuse(f"a chunk or message makes more than {CHUNK_LIMIT} bytes")
        return b"".join(parts)


def _unpacked(path: Path, unpack: Callable[[Any], Any]) -> Scan:
    """What lies in a compressed file; errors and warnings name the file itself."""
    growth = _Growth(path, path.stat().st_size)
    with ExitStack() as until:
        whole = Path(until.enter_context(tempfile.TemporaryDirectory())) / "unpacked"
        try:
            with path.open("rb") as packed, whole.open("wb") as out, unpack(packed) as stream:
                while part := stream.read(_STEP):
                    growth.spend(len(part))
                    out.write(part)
        except (OSError, EOFError, ValueError, zlib.error, zstandard.ZstdError) as error:
            raise DriverError(f"{path}: cannot be unpacked: {error}") from error
        with whole.open("rb") as file:
            if _unpacker(file.read(len(_ZSTD))):
                raise DriverError(f"{path}: is packed twice; unpack it once")
        try:
            scan = open_scan(whole)
        except DriverError as error:
            raise DriverError(str(error).replace(str(whole), str(path))) from error
        scan.path, scan.stored = path, path.stat().st_size
        weakref.finalize(scan, until.pop_all().close)
    return scan


class FolderScan(Scan):
    """One pass over a rosbag2: the files of a folder, one after the other."""

    def __init__(self, path: Path) -> None:
        """Read which files it has. Raises DriverError."""
        super().__init__(path)
        try:
            self._files = _files_of(path)
        except DriverError as error:
            self._files = sorted(p for p in path.iterdir() if p.suffix in names.RECORDINGS)
            if len(self._files) != 1:
                raise
            self.warnings.append(f"{error}; the only file there is read, {self._files[0].name}")

    def regions(self) -> Iterator[Region]:
        """The messages of its files. Raises DriverError where one of them cannot be read."""
        channels: dict[tuple[str, str, str], None] = {}
        growth = _Growth(self.path, sum(file.stat().st_size for file in self._files))
        for file in self._files:
            part = open_scan(file)
            for region in part.regions():
                growth.spend(int((region.stop - region.start).sum()))
                # Each file numbers its channels in its own way.
                self.channels, self.schemas = part.channels, part.schemas
                yield region
            for channel in part.channels.values():
                kind = schema_name(part, channel)
                channels[channel.topic, channel.message_encoding, kind] = None
            for topic, count in part.passed.items():
                self.passed[topic] = self.passed.get(topic, 0) + count
            self.header, self.truncated = part.header, self.truncated or part.truncated
            self.metadata += part.metadata
            self.attachments += part.attachments
            self.warnings += part.warnings
        self.channels, self.schemas = {}, {}
        for number, (topic, encoding, kind) in enumerate(channels):
            self.schemas[number] = Schema(number, b"", "ros2msg", kind)
            self.channels[number] = Channel(number, topic, encoding, {}, number)


class BagScan(Scan):
    """One pass over a bag of ROS 1, or an SQLite file of rosbag2."""

    def __init__(self, path: Path, kind: str) -> None:
        """Args: path: of the bag; kind: ".db3" or ".bag"."""
        super().__init__(path)
        self._whole, self._kind = path.resolve(), kind
        self._one = kind == ".bag"
        if path.with_name(f"{path.name}-wal").exists():
            self.warnings.append(
                f"{path}: what lies in {path.name}-wal is not read (sqlite3 opens "
                "the file and writes it in)"
            )

    def regions(self) -> Iterator[Region]:
        """The messages of known types; others are counted in `passed`. Raises DriverError."""
        self._growth = _Growth(self.path, self.stored)
        with tempfile.TemporaryDirectory() as folder:
            # Under a plain name: in the user's `?` and `#` would be read as parts of an address.
            link = Path(folder) / f"bag{self._kind}"
            link.symlink_to(self._whole)
            try:
                yield from self._messages(link)
            except DriverError:
                raise
            except Exception as error:  # rosbags' own, SQLite's, and those of damaged bytes
                said = " ".join(str(error).replace(str(link), "it").split())[:200]
                raise DriverError(
                    f"{self.path}: is a damaged or unfinished bag: {said or type(error).__name__}"
                    + (" (`rosbag reindex` may mend it)" if self._one else "")
                ) from error

    def _messages(self, link: Path) -> Iterator[Region]:
        growth = _Growth(self.path, self.stored)
        with (_open_ros1 if self._one else _open_sqlite)(link, growth) as bag:
            for c in bag.connections:
                if not (isinstance(c.topic, str) and isinstance(c.msgtype, str)):
                    raise ValueError("the name or type of a topic is no text")
                kind = JOINT_STATE if self._one and c.msgtype == FRANKA_STATE else c.msgtype
                self.schemas[c.id] = Schema(c.id, b"", "ros2msg", kind)
                encoding = "cdr" if self._one else c.ext.serialization_format
                self.channels[c.id] = Channel(c.id, c.topic, encoding, {}, c.id)
            chosen = [c for c in bag.connections if c.msgtype in PARSERS]
            for c in bag.connections:
                if c not in chosen:
                    self.passed[c.topic] = self.passed.get(c.topic, 0) + c.msgcount
            if chosen:
                told = {c.msgtype: c.msgdef.data for c in chosen} if self._one else {}
                convert = _to_cdr(told) if self._one else None
                yield from _regions(self._told(bag.messages(chosen), convert))

    def _told(
        self, messages: Iterator[Any], convert: Callable[[str, bytes], bytes] | None
    ) -> Iterator[tuple[bytes, bytes]]:
        """Head and content of each message."""
        for number, (connection, time_ns, raw) in enumerate(messages):
            raw = self._growth.message(raw)
            if convert is not None:
                raw = convert(connection.msgtype, raw)
            yield _HEAD.pack(connection.id, number % 2**32, time_ns, time_ns), raw


def _open_sqlite(path: Path, growth: _Growth) -> Any:
    """A reader of an SQLite file, whose messages are what it stores and nothing more.

    A database may compute what a table holds, and point to the same bytes again and again, so
    that a few bytes fill the memory while they are sorted. Raises DriverError.
    """
    with closing(sqlite3.connect(f"file:{path}?mode=ro&immutable=1", uri=True)) as base:
        made = base.execute(_COMPUTED).fetchone()
        if made is not None:
            growth.refuse(f"computes '{made[0]}' instead of storing it")
        topics = base.execute("SELECT * FROM topics")
        columns = [column[0] for column in topics.description]
        told = [dict(zip(columns, row, strict=True)).get(_QOS) or "" for row in topics]
        # rosbags reads these as YAML, in which anchors are what grows.
        if sum(len(str(x)) for x in told) > _METADATA_LIMIT or any("&" in str(x) for x in told):
            growth.refuse(f"has {_QOS} that no recorder writes")
        (size,) = base.execute("SELECT total(length(data)) FROM messages").fetchone()
    if size > path.stat().st_size:
        growth.refuse(f"would tell {size:.0f} bytes of messages, more than it has")
    return importlib.import_module("rosbags.rosbag2").Reader(path)


@contextmanager
def _open_ros1(path: Path, growth: _Growth) -> Iterator[Any]:
    """A reader whose chunks make no more than `growth` allows, and whose index is read once.

    Each unpacking counts: an index that goes to and fro between chunks would never come to an end.
    """
    reader = importlib.import_module("rosbags.rosbag1").Reader(path)
    read_chunk, read_index = reader.read_chunk, reader.read_index_data
    left = path.stat().st_size  # of the index, which lies in the file

    def read_bounded() -> Any:
        def unpack(data: bytes) -> bytes:  # records never begin like what packs them
            if data.startswith(b"BZh"):
                content = growth.all_of(bz2.BZ2File(BytesIO(data)))
            elif data.startswith(b"\x04\x22\x4d\x18"):  # LZ4
                frame = importlib.import_module("lz4.frame")
                content = growth.all_of(frame.LZ4FrameFile(BytesIO(data)))
            else:
                return data
            growth.spend(len(content))
            return content

        return read_chunk()._replace(decompressor=unpack)

    def read_index_once(place: int, indexes: Any) -> None:
        nonlocal left
        begin = reader.bio.tell()
        read_index(place, indexes)
        left -= reader.bio.tell() - begin
        if left < 0:
            growth.refuse("has chunks that share their index")

    reader.read_chunk, reader.read_index_data = read_bounded, read_index_once
    with reader:
        yield reader


class McapOfAnyRos(McapScan):
    """One pass over an MCAP file; what ROS 1 serialized is told as CDR, what is packed unpacked."""

    def __init__(self, path: Path) -> None:
        """Open the file. Raises DriverError where it cannot be an MCAP file."""
        super().__init__(path)
        self._from_ros1: dict[int, Callable[[bytes], bytes]] = {}  # by channel

    def regions(self) -> Iterator[Region]:
        """All complete messages, in the order of the file; damaged chunks are passed over."""
        self._growth = _Growth(self.path, self.stored)
        for region in super().regions():
            numbers = np.unique(region.channel).tolist()
            # A file repeats its channels in each chunk, so their telling is put right each time.
            for number in numbers:
                self._tell_as_cdr(number)
            # (k,) which messages of known types are packed one by one, as rosbag2 can
            packed = np.zeros(len(region.start), bool)
            long = np.flatnonzero(region.stop - region.start > len(_ZSTD))
            begin = region.rows(region.start[long], len(_ZSTD))
            packed[long] = (begin == np.frombuffer(_ZSTD, np.uint8)).all(axis=1)
            if packed.any():
                known = [n for n, c in self.channels.items() if schema_name(self, c) in PARSERS]
                packed &= np.isin(region.channel, known)
            if packed.any() or any(number in self._from_ros1 for number in numbers):
                yield from _regions(self._told(region, packed))
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
            try:
                convert = _to_cdr({kind: schema.data.decode()})
            except Exception as error:  # of whatever kind rosbags' parser raises
                said = " ".join(str(error).split())[:200] or type(error).__name__
                self._warn(f"the definition of {schema.name} cannot be read: {said}")
                return
            self._from_ros1[number] = partial(convert, kind)
        told = JOINT_STATE if kind == FRANKA_STATE else kind
        own = 2**16 + number  # beyond the numbers that a file can give its schemas
        self.schemas[own] = Schema(own, b"", "ros2msg", told)
        self.channels[number] = Channel(number, channel.topic, "cdr", channel.metadata, own)

    def _told(self, region: Region, packed: NDArray[np.bool_]) -> Iterator[tuple[bytes, bytes]]:
        """Head and content of each message."""
        places = zip(region.start.tolist(), region.stop.tolist(), packed.tolist(), strict=True)
        for (start, stop, pack), number in zip(places, region.channel.tolist(), strict=True):
            raw = region.data[start:stop].tobytes()
            if pack:
                raw = self._growth.message(raw)
            convert = self._from_ros1.get(number)
            head = region.data[start - _HEAD.size : start].tobytes()
            yield head, raw if convert is None else convert(raw)


def _regions(messages: Iterator[tuple[bytes, bytes]]) -> Iterator[Region]:
    """Heads and contents, some thousand together."""
    more = True
    while more:
        more, data, starts, stops = False, bytearray(), [], []
        for head, content in messages:
            data += head
            starts.append(len(data))
            data += content
            stops.append(len(data))
            if len(starts) == 4096 or len(data) > _REGION_BYTES:  # messages of one region
                more = True
                break
        if starts:
            yield Region(np.frombuffer(data, np.uint8), np.array(starts), np.array(stops))


def _empty(types: Mapping[str, Any]) -> set[str]:
    """The messages that take no byte, of types and their fields as `rosbags` tells them."""
    empty, before = set(types), len(types) + 1
    while len(empty) < before:
        before = len(empty)
        empty = {name for name in empty if all(_no_bytes(f, empty) for _, f in types[name][1])}
    return empty


def _no_bytes(field: Any, empty: set[str]) -> bool:
    node, of = field
    if node.name == "ARRAY":
        return of[1] == 0 or _no_bytes(of[0], empty)
    return node.name == "NAME" and of in empty


def _to_cdr(definitions: dict[str, str]) -> Callable[[str, bytes], bytes]:
    """What turns a message of ROS 1 into CDR; one that cannot be read becomes empty.

    Args:
        definitions: of each type, as a bag of ROS 1 has them.
    """
    typesys = importlib.import_module("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)  # whose headers have no `seq`
    for kind, text in definitions.items():
        found = typesys.get_types_from_msg(text, kind)
        empty = _empty({**store.fielddefs, **found}) & set(found)
        if empty:  # any number of them fits into a message, and would be walked over
            raise ValueError(f"{sorted(empty)[0]} has no bytes")
        store.register({k: v for k, v in found.items() if k not in store.fielddefs})

    def convert(kind: str, raw: bytes) -> bytes:
        try:
            cdr = bytes(store.ros1_to_cdr(raw, kind))
        except Exception:  # of whatever kind; the message is then counted as unreadable
            return b""
        if kind != FRANKA_STATE:
            return cdr
        state = store.deserialize_cdr(cdr, kind)
        names = [f"joint{i + 1}" for i in range(len(state.q))]
        told = store.types[JOINT_STATE](state.header, names, state.q, state.dq, state.tau_J)
        return bytes(store.serialize_cdr(told, JOINT_STATE))

    return convert
