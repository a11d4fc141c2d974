"""What the topics of a recording take of its size: python -m tests.benchmarks.recording_size FILE

Each topic is written alone into a file like that of the recorder (chunks of half a second, zstd);
what the files of several topics share is small.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer

CHUNK_S = 0.5


def size_of(path: Path, topics: set[str]) -> int:
    """Bytes of a file with these topics alone."""
    with tempfile.TemporaryDirectory() as folder, path.open("rb") as source:
        part = Path(folder) / "part.mcap"
        with part.open("wb") as file:
            writer, channels, flushed = Writer(file), {}, 0
            writer.start(profile="ros2", library="size")
            for schema, channel, message in make_reader(source).iter_messages(list(topics)):
                assert schema is not None
                if channel.topic not in channels:
                    number = writer.register_schema(schema.name, schema.encoding, schema.data)
                    channels[channel.topic] = writer.register_channel(
                        channel.topic, channel.message_encoding, number, channel.metadata
                    )
                if message.log_time - flushed > 1e9 * CHUNK_S:
                    writer.flush()
                    flushed = message.log_time
                writer.add_message(
                    channels[channel.topic], message.log_time, message.data, message.publish_time
                )
            writer.finish()
        return part.stat().st_size


def main(path: Path) -> None:
    """Print kB/s by topic."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    topics = {channel.topic: counts.get(k, 0) for k, channel in summary.channels.items()}
    span_s = 1e-9 * (summary.statistics.message_end_time - summary.statistics.message_start_time)
    print(f"{path.name}: {span_s:.1f} s, {path.stat().st_size / span_s / 1e3:.1f} kB/s")
    for topic in sorted(topics):
        rate = size_of(path, {topic}) / span_s / 1e3
        print(f"  {topic}: {topics[topic]} messages, {rate:.1f} kB/s")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
