"""Mends a cut or damaged recording: all complete messages into a file with a proper end."""

from __future__ import annotations

import os
import tempfile
from collections import Counter
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import IO

from mcap.records import Channel
from mcap.writer import Writer

from drivers.files.mcap.records import McapScan
from drivers.files.mcap.writer import LIBRARY
from drivers.interface import DriverError


@dataclass(frozen=True, slots=True)
class Recovery:
    """What `recover` did.

    Attributes:
        path, out: the file read, the file written.
        was_whole: nothing was wrong with it.
        messages: written, by topic.
        lost_bytes: of the file that hold no complete record.
        warnings: what was wrong.
    """

    path: Path
    out: Path
    was_whole: bool
    messages: dict[str, int]
    lost_bytes: int
    warnings: list[str]


def recover(path: str | Path, out: str | Path | None = None) -> Recovery:
    """Rewrite a recording with every complete message, also those of a cut last chunk.

    The file itself stays as it is unless `out` names it; the new file appears under its name only
    when it is complete.

    Args:
        path: the recording.
        out: the mended file; `NAME.recovered.mcap` beside it where None.

    Raises:
        DriverError: the file is unreadable, or the new one exists or cannot be written.
    """
    path = Path(path)
    out = path.with_suffix(".recovered.mcap") if out is None else Path(out)
    scan = McapScan(path)
    if out.exists() and not out.samefile(path):
        raise DriverError(f"{out}: exists; choose another name or delete it")
    try:
        with tempfile.NamedTemporaryFile(dir=out.parent, suffix=".part", delete=False) as file:
            try:
                counts = _copy(scan, file)
                file.flush()
                os.fsync(file.fileno())
                os.chmod(file.name, path.stat().st_mode & 0o777)
                os.replace(file.name, out)
            except BaseException:
                os.unlink(file.name)
                raise
    except OSError as error:
        raise DriverError(f"{out}: cannot be written: {error.strerror}") from error
    return Recovery(
        path=path,
        out=out,
        was_whole=not scan.warnings,
        messages=dict(sorted(counts.items())),
        lost_bytes=scan.lost_bytes,
        warnings=scan.warnings,
    )


def _copy(scan: McapScan, file: IO[bytes]) -> Counter[str]:
    """Copy all messages, then metadata and attachments; counts by topic."""
    writer = Writer(file)
    numbers: dict[int, int] = {}
    counts: Counter[str] = Counter()
    written: dict[int, int] = {}
    orphans = 0
    regions = scan.regions()
    first = next(regions, None)  # the header comes before all messages
    writer.start(profile=scan.header.profile, library=LIBRARY)
    for region in regions if first is None else chain([first], regions):
        facts = region.start, region.stop, region.channel, region.sequence, region.times
        for start, stop, number, sequence, times in zip(*(x.tolist() for x in facts), strict=True):
            channel = scan.channels.get(number)
            if channel is None:
                orphans += 1
                continue
            if number not in numbers:
                numbers[number] = _register(writer, scan, channel, written)
            payload = region.data[start:stop].tobytes()
            writer.add_message(numbers[number], times[0], payload, times[1], sequence)
            counts[channel.topic] += 1
    if orphans:
        scan.warnings.append(f"{scan.path}: {orphans} messages belong to no channel; left out")
    for record in scan.metadata:
        writer.add_metadata(record.name, record.metadata)
    for x in scan.attachments:
        writer.add_attachment(x.create_time, x.log_time, x.name, x.media_type, x.data)
    writer.finish()
    return counts


def _register(writer: Writer, scan: McapScan, channel: Channel, written: dict[int, int]) -> int:
    schema, number = scan.schemas.get(channel.schema_id), 0
    if schema is not None:
        if schema.id not in written:
            written[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
        number = written[schema.id]
    about = channel.topic, channel.message_encoding, number, channel.metadata
    return int(writer.register_channel(*about))
