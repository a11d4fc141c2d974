"""A sample of a long MCAP file: stretches spread over it, and what its index says of the whole.

Nothing but the index and some chunks is read, however large the file is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode

from drivers.files.mcap.log import Log, Topic
from drivers.files.mcap.read import Beside, assembled
from drivers.files.mcap.records import HEAD, RECORD, McapScan, Region
from drivers.files.mcap.series import schema_name
from drivers.interface import DriverError

SAMPLED_FROM = 2**26  # bytes; a smaller file is read whole
_INDEXED = {Opcode.METADATA_INDEX: Opcode.METADATA, Opcode.ATTACHMENT_INDEX: Opcode.ATTACHMENT}
STRETCHES, STRETCH_BYTES = 24, 2**20  # how many, and of what each holds unpacked, about


def sample_log(
    path: str | Path, topic: str | None = None, beside: Beside = ""
) -> tuple[list[Log], list[tuple[float, float]]] | None:
    """A sample of a long MCAP file with an index; None of every other recording.

    Args:
        path: of the file; topic: of the joint states; beside: as `read_log` takes it.

    Returns:
        Stretches in the order of time, of the same joints and topic, whose topics count the
        messages of the whole, and the holes (s since the first sample, s) between chunks outside
        of the stretches.
    """
    file = Path(path)
    if not file.is_file() or file.stat().st_size < SAMPLED_FROM:
        return None
    try:
        scan = _Part(file)
    except DriverError:  # the scan that reads all says what is wrong
        return None
    chunks = sorted(scan.others[Opcode.CHUNK_INDEX], key=lambda c: c.chunk_start_offset)
    if not chunks or not scan.others[Opcode.STATISTICS]:
        return None
    # Places of chunks, some in a row, spread evenly from the first to the last.
    size = float(np.median([c.uncompressed_size for c in chunks]))
    together = max(round(STRETCH_BYTES / max(size, 1.0)), 1)
    starts = np.unique(np.linspace(0, max(len(chunks) - together, 0), STRETCHES).astype(int))
    stretches = [range(i, min(i + together, len(chunks))) for i in starts.tolist()]
    if sum(map(len, stretches)) > len(chunks) // 2:
        return None
    scan.note_others()
    found = []
    for stretch in stretches:
        scan.chosen = [chunks[i].chunk_start_offset for i in stretch]
        try:
            found.append(assembled(scan, None, topic, beside))
        except DriverError:  # this stretch has no joint states, others may
            continue
    if not found or not scan.sound:
        return None
    first = found[0]
    warnings = list(dict.fromkeys(text for part in found for text in part.warnings))
    topics: dict[str, Topic] = {}
    counts = scan.others[Opcode.STATISTICS][-1].channel_message_counts
    for channel in sorted(scan.channels.values(), key=lambda c: str(c.topic)):
        before = topics[channel.topic].messages if channel.topic in topics else 0
        messages = before + counts.get(channel.id, 0)
        about = schema_name(scan, channel), channel.message_encoding
        topics[channel.topic] = Topic(*about, messages)
    parts = [
        replace(part, topics=topics, warnings=warnings)
        for part in found
        if (part.joint_names, part.topic) == (first.joint_names, first.topic)
    ]
    inside = {i for stretch in stretches for i in stretch[1:]}
    begin, holes = chunks[0].message_start_time, []
    for i in range(1, len(chunks)):
        before, behind = chunks[i - 1].message_end_time, chunks[i].message_start_time
        if i not in inside and behind > before:
            holes.append((1e-9 * (before - begin), 1e-9 * (behind - before)))
    return parts, holes


class _Part(McapScan):
    """Some chunks of a file, with the channels that its index knows.

    Attributes:
        chosen: places of the chunks that `regions` reads.
        sound: whether they were chunks.
    """

    chosen: Sequence[int] = ()
    sound = True

    def regions(self) -> Iterator[Region]:
        """The messages of the chosen chunks."""
        self._made = 0
        for place in self.chosen:
            self._give_back(place)
            stop = self._end_of(place, Opcode.CHUNK)
            if not stop:
                self.sound = False
                return
            yield from self._chunk(place, stop)

    def note_others(self) -> None:
        """Read metadata and attachments, which the index has the places of."""
        for index, opcode in _INDEXED.items():
            for place in self.others[index]:
                if stop := self._end_of(place.offset, opcode):
                    self._note(opcode, self._data[place.offset + HEAD : stop])

    def _end_of(self, place: int, opcode: Opcode) -> int:
        """Where a whole record there ends; 0 where there is none of that kind."""
        if place + HEAD > self.size or self._data[place] != opcode:
            return 0
        stop = place + HEAD + int(RECORD.unpack_from(self._data, place)[1])
        return stop if stop <= self.size else 0
