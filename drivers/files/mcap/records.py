"""The records of an MCAP file, read front to back, so that a cut or damaged file gives all it has.

Chunks are decompressed, whole or cut, and walked over; messages come as a `Region`: arrays of
places in the bytes of a chunk, or of the file itself where it is not chunked, so that numpy can
take all messages of a topic at once. The index at the end of a file is not needed; where it is
sound it helps past damage. Source: MCAP specification, "Records".
"""

from __future__ import annotations

import bisect
import importlib
import mmap
import struct
import zlib
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from numpy.typing import NDArray

from drivers.files.bounded import CHUNK_LIMIT, GROWTH_LIMIT
from drivers.interface import DriverError

_MOST_OTHERS = 2**18  # records of a stretch that are no messages; channel numbers have 16 bits
_MOST_WARNINGS = 50
_LOOK = 16  # messages behind which it is looked whether their sizes come again in turn
_TOGETHER = 2**16  # messages of a region where they lie in no chunk
_KEPT_PAGES = 2**25  # bytes of the file that stay mapped behind what was read
HEAD = 9  # opcode and length
RECORD = struct.Struct("<BQ")
_MESSAGE_HEAD = 22  # channel, sequence, log time, publish time
MAGIC = b"\x89MCAP0\r\n"
_CHUNK_HEAD = struct.Struct("<QQQII")  # start, end, size, crc, length of the compression's name
_FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of the index, of its offsets, crc
_LENGTH = struct.Struct("<Q")
_NOTED: dict[
    int, Any
] = {  # what is kept, each read by its class; all others are messages, or of no use
    int(Opcode.SCHEMA): Schema,
    int(Opcode.CHANNEL): Channel,
    int(Opcode.HEADER): Header,
    int(Opcode.METADATA): Metadata,
    int(Opcode.ATTACHMENT): Attachment,
    int(Opcode.CHUNK_INDEX): ChunkIndex,
    int(Opcode.METADATA_INDEX): MetadataIndex,
    int(Opcode.ATTACHMENT_INDEX): AttachmentIndex,
    int(Opcode.STATISTICS): Statistics,
}
_INVALID = 0  # what a file system leaves behind a cut: zeros
_IN_CHUNK = frozenset({_INVALID})
_IN_FILE = frozenset({_INVALID, int(Opcode.CHUNK), int(Opcode.DATA_END), int(Opcode.FOOTER)})


class DamagedChunk(ValueError):
    """A chunk's bytes are not what its head says."""


def decompress(chunk: Chunk, cut: bool = False) -> memoryview:
    """The records of a chunk, whatever its own head or a frame's claims.

    Args:
        chunk: with its compressed bytes.
        cut: the end is missing; give what can be had.

    Raises:
        DamagedChunk: the bytes cannot be decompressed, or make another size.
    """
    name, size = chunk.compression, chunk.uncompressed_size
    try:
        if name == "zstd":
            with zstandard.ZstdDecompressor().stream_reader(chunk.data) as reader:
                content = memoryview(reader.read(size + 1))
        elif name == "lz4":
            frame = importlib.import_module("lz4.frame")  # comes with mcap; seldom needed
            stream = frame.LZ4FrameDecompressor()
            content = memoryview(stream.decompress(chunk.data, max_length=size + 1))
        elif name == "":
            content = memoryview(chunk.data)
        else:
            raise DamagedChunk(f"it is compressed by {name!r} (known: none, zstd, lz4)")
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise DamagedChunk(f"{name} cannot read it ({error})") from error
    if not cut and len(content) != size:
        raise DamagedChunk(f"it does not make the {size} bytes that it claims")
    if not cut and chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc:
        raise DamagedChunk("its checksum is wrong")
    return content


@dataclass(frozen=True, slots=True)
class Region:
    """Messages that lie in one stretch of bytes.

    Attributes:
        data: the bytes.
        start: (k,) where each payload begins in `data`.
        stop: (k,) where it ends.
    """

    data: NDArray[np.uint8]
    start: NDArray[np.int64]
    stop: NDArray[np.int64]

    @property
    def channel(self) -> NDArray[np.int64]:
        """(k,) channel numbers."""
        return self.rows(self.start - 22, 2).view("<u2")[:, 0].astype(np.int64)

    @property
    def sequence(self) -> NDArray[np.int64]:
        """(k,) sequence numbers."""
        return self.rows(self.start - 20, 4).view("<u4")[:, 0].astype(np.int64)

    @property
    def times(self) -> NDArray[np.uint64]:
        """(k, 2) log time and publish time, ns."""
        return self.rows(self.start - 16, 16).view("<u8").astype(np.uint64)

    def rows(self, start: NDArray[np.int64], size: int) -> NDArray[np.uint8]:
        """(k, size) the bytes from each of `start` on."""
        if size == 0 or len(start) == 0:
            return np.empty((len(start), size), np.uint8)
        return np.lib.stride_tricks.sliding_window_view(self.data, size)[start]


@dataclass
class Walk:
    """What one pass over a stretch of records found.

    Attributes:
        start, stop: of the messages' payloads; others: opcode, first and last byte.
        end: where it stopped; full: because there were as many messages as were asked for.
    """

    start: array[int] = field(default_factory=lambda: array("q"))
    stop: array[int] = field(default_factory=lambda: array("q"))
    others: list[tuple[int, int, int]] = field(default_factory=list)  # opcode, first, last byte
    end: int = 0
    full: bool = False


def walk(data: memoryview, at: int, until: frozenset[int], most: int | None = None) -> Walk:
    """Note complete records from `at` on, up to `most` messages, an opcode of `until` or a cut."""
    found = Walk()
    note_start, note_stop, unpack = found.start.append, found.stop.append, RECORD.unpack_from
    message, size, look = int(Opcode.MESSAGE), len(data), _LOOK
    while at + HEAD <= size:
        opcode, length = unpack(data, at)
        stop = at + HEAD + length
        if stop > size or opcode in until:
            break
        if opcode != message:
            if opcode in _NOTED:
                found.others.append((opcode, at + HEAD, stop))
                if len(found.others) > _MOST_OTHERS:
                    break
        elif length < _MESSAGE_HEAD:
            break
        else:
            if len(found.start) == most:
                found.full = True
                break
            note_start(at + HEAD + _MESSAGE_HEAD)
            note_stop(stop)
        at = stop
        if len(found.start) >= look:
            at = _note_repeated(found, data, at, most)
            look = len(found.start) + _LOOK
    found.end = at
    return found


def _note_repeated(found: Walk, data: memoryview, at: int, most: int | None) -> int:
    """Note messages that have the sizes of the last ones again, one or some in turn, at once.

    Returns where they end. A log at 1 kHz has a million messages of a size in a quarter of an hour.
    """
    begin, end = np.array(found.start[-_LOOK:]), np.array(found.stop[-_LOOK:])
    begin -= HEAD + _MESSAGE_HEAD
    sizes = end - begin
    for turn in range(1, _LOOK // 2 + 1):
        if (sizes[-turn:] == sizes[-2 * turn : -turn]).all():
            break
    else:
        return at
    heads = begin[-turn:] - begin[-turn]
    width = int(sizes[-turn:].sum())
    if at - begin[-turn] != width:  # something else lies between them
        return at
    times = (len(data) - at) // width
    if most is not None:
        times = min(times, (most - len(found.start)) // turn)
    head = (heads[:, None] + np.arange(HEAD)).ravel()
    rows = np.frombuffer(data, np.uint8, times * width, at).reshape(times, width)
    last = np.frombuffer(data, np.uint8, width, at - width)
    same = rows[:, head] == last[head]
    times = times if same.all() else int(np.argmin(same.all(axis=1)))
    places = at + heads + width * np.arange(times)[:, None]
    found.start.frombytes((places + (HEAD + _MESSAGE_HEAD)).tobytes())
    found.stop.frombytes((places + sizes[-turn:]).tobytes())
    return at + times * width


class Scan:
    """One pass over a recording. Its attributes are complete once `regions` is exhausted.

    Attributes:
        path: the file or folder.
        stored: its bytes, as they came; what it may make of them is judged by these.
        header: profile and library.
        schemas, channels: by number.
        metadata, attachments: in the order of the file.
        truncated: the file has no proper end.
        passed: messages of topics that `regions` passes over.
        within_s: log times since the first message that are read, all where None; what lies outside
            is counted.
        warnings: what was wrong with the file, one sentence each.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.stored = path.stat().st_size if path.is_file() else 0
        self.header = Header("", "")
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: list[Metadata] = []
        self.attachments: list[Attachment] = []
        self.truncated = False
        self.passed: dict[str, int] = {}
        self.within_s: tuple[float, float] | None = None
        self.warnings: list[str] = []

    def regions(self) -> Iterator[Region]:
        """Complete messages, in the order of the recording."""
        raise NotImplementedError


class McapScan(Scan):
    """One pass over an MCAP file.

    Attributes:
        size: its bytes.
        others: metadata, attachments, and what a sound end of the file says of it, by opcode.
        lost_bytes: bytes behind the cut that hold no complete record.
    """

    def __init__(self, path: Path) -> None:
        """Open the file. Raises DriverError where it cannot be an MCAP file."""
        super().__init__(path)
        self._data = _open(path)
        self.size = len(self._data)
        self.others: dict[int, list[Any]] = {opcode: [] for opcode in _NOTED}
        self.metadata = self.others[Opcode.METADATA]
        self.attachments = self.others[Opcode.ATTACHMENT]
        self.lost_bytes = 0
        self._rescued = self._made = self._given_back = 0
        self._chunks: list[int] = []
        self._read_index()

    def regions(self) -> Iterator[Region]:
        """All complete messages, in the order of the file; damaged chunks are passed over."""
        at = len(MAGIC)
        while True:
            self._give_back(at)
            # of the next chunk, as far as the index knows it
            place = bisect.bisect_right(self._chunks, at)
            bound = self._chunks[place] if place < len(self._chunks) else self.size
            found = walk(self._data[:bound], at, _IN_FILE, _TOGETHER)
            yield from self._use(found, self._data)
            at = found.end
            if found.full or at == bound < self.size:
                continue
            is_chunk = at + HEAD <= self.size and self._data[at] == Opcode.CHUNK
            stop = at + HEAD + RECORD.unpack_from(self._data, at)[1] if is_chunk else bound + 1
            if stop <= bound:
                yield from self._chunk(at, stop)
                at = stop
            elif bound < self.size:
                self.lost_bytes += bound - at
                self._warn(f"bytes {at} to {bound} are damaged and were passed over")
                at = bound
            else:
                if is_chunk:
                    yield from self._chunk(at, stop)
                break
        ended = at + HEAD <= self.size and self._data[at] in (Opcode.DATA_END, Opcode.FOOTER)
        self.truncated = not ended or bytes(self._data[-len(MAGIC) :]) != MAGIC
        if not ended:
            self.lost_bytes += self.size - at
            rescued = f"; {self._rescued} messages of them could be read" if self._rescued else ""
            self._warn(
                f"the file is cut: of its {self.size} bytes the last {self.size - at} are an "
                f"incomplete record{rescued} (`adapter recover` mends it)"
            )
        elif self.truncated:
            self._warn("the file is cut in its index; no message is lost")

    def _give_back(self, at: int) -> None:
        """Let go of mapped pages before `at`, which would count as memory in use."""
        whole = at // _KEPT_PAGES * _KEPT_PAGES
        mapped = self._data.obj
        if whole > self._given_back and hasattr(mmap, "MADV_DONTNEED"):
            assert isinstance(mapped, mmap.mmap)
            mapped.madvise(mmap.MADV_DONTNEED, self._given_back, whole - self._given_back)
            self._given_back = whole

    def _read_index(self) -> None:
        """Channels and places of chunks from a sound index, of use where the data are damaged."""
        end = self.size - len(MAGIC)
        footer = end - _FOOTER.size
        if bytes(self._data[end:]) != MAGIC or footer < len(MAGIC):
            return
        opcode, _, start, _, crc = _FOOTER.unpack_from(self._data, footer)
        if opcode != Opcode.FOOTER or not len(MAGIC) <= start <= footer:
            return
        if crc and zlib.crc32(self._data[start : end - 4]) != crc:
            return
        for opcode, first, last in walk(self._data[:footer], start, _IN_CHUNK).others:
            if opcode not in (Opcode.HEADER, Opcode.METADATA, Opcode.ATTACHMENT):
                self._note(opcode, self._data[first:last])
        places = (chunk.chunk_start_offset for chunk in self.others[Opcode.CHUNK_INDEX])
        self._chunks = sorted(x for x in places if x < start and self._data[x] == Opcode.CHUNK)

    def _use(self, found: Walk, data: memoryview) -> Iterator[Region]:
        for opcode, first, last in found.others:
            self._note(opcode, data[first:last])
        if found.start:
            starts, stops = np.array(found.start, np.int64), np.array(found.stop, np.int64)
            yield Region(np.frombuffer(data, np.uint8), starts, stops)

    def _note(self, opcode: int, content: memoryview) -> None:
        """Keep a record that isn't a message."""
        try:
            record = _NOTED[opcode].read(ReadDataStream(BytesIO(content)))
        except (McapError, struct.error, UnicodeDecodeError) as error:
            self._warn(f"a record of type {opcode} is damaged and was passed over ({error})")
            return
        if opcode == Opcode.SCHEMA:
            self.schemas[record.id] = record
        elif opcode == Opcode.CHANNEL:
            self.channels[record.id] = record
        elif opcode == Opcode.HEADER:
            self.header = record
        else:
            self.others[opcode].append(record)

    def _chunk(self, at: int, stop: int) -> Iterator[Region]:
        """Its messages; of a cut one what can be had, and no checksum holds it to anything."""
        cut = stop > self.size
        try:
            # its bytes are not copied; of a cut one there are as many as there are
            begin, end, size, crc, length = _CHUNK_HEAD.unpack_from(self._data, at + HEAD)
            name_at = at + HEAD + _CHUNK_HEAD.size
            name = str(self._data[name_at : name_at + length], "utf-8")
            (stored,) = _LENGTH.unpack_from(self._data, name_at + length)
            first = name_at + length + _LENGTH.size
            data: Any = self._data[first : first + stored]
            chunk = Chunk(name, data, end, begin, crc, size)
            size = chunk.uncompressed_size
            if size > CHUNK_LIMIT:
                raise DamagedChunk(f"it claims {size} bytes, at most {CHUNK_LIMIT} are read")
            if self._made + size > GROWTH_LIMIT * self.stored + CHUNK_LIMIT:
                raise DamagedChunk(f"the file would grow more than {GROWTH_LIMIT} times")
            self._made += size
            content = decompress(chunk, cut)
            found = walk(content, 0, _IN_CHUNK)
            if not cut and found.end != len(content):
                raise DamagedChunk(f"its record at byte {found.end} is broken")
        except (DamagedChunk, struct.error, UnicodeDecodeError) as error:
            if not cut:
                self.lost_bytes += stop - at
                self._warn(f"the chunk at byte {at} is damaged and was passed over: {error}")
            return
        self._rescued = len(found.start) if cut else 0
        yield from self._use(found, content)

    def _warn(self, sentence: str) -> None:
        if len(self.warnings) < _MOST_WARNINGS:
            self.warnings.append(f"{self.path}: {sentence}")
        elif len(self.warnings) == _MOST_WARNINGS:
            self.warnings.append(f"{self.path}: has more damage, which is not listed")


def _open(path: Path) -> memoryview:
    try:
        with path.open("rb") as file:
            if path.stat().st_size == 0:
                raise DriverError(f"{path}: is empty (0 bytes); nothing was recorded")
            data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except OSError as error:
        raise DriverError(f"{path}: cannot be read: {error.strerror}") from error
    begin = bytes(data[: len(MAGIC)])
    if begin == MAGIC:
        return data
    if MAGIC.startswith(begin):
        raise DriverError(f"{path}: is cut after {len(begin)} bytes; nothing was recorded")
    raise DriverError(
        f"{path}: is not an MCAP recording, rosbag2 or ROS 1 bag; it begins with {begin!r}; "
        "`adapter import` turns tables into recordings"
    )
