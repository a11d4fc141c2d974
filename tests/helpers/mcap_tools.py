"""Recordings for tests: ours, and such as other people's tools write."""

import math
import subprocess
import sys
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer

from drivers.files.mcap import McapWriter
from drivers.files.messages import JointStateEncoder
from drivers.files.ros_types import JOINT_STATE, schemas
from drivers.interface import JointSample, LinkMotion

JOINTS = ("shoulder", "elbow", "wrist")
LINKS = ("upper", "lower", "hand")
START_NS = 5_000_000_000
STEP_NS = 1_000_000
_ALONE = """
import sys
from drivers.files import mcap
try:
    print(getattr(mcap, sys.argv[1])(sys.argv[2]))
except Exception as error:
    print(type(error).__name__, error)
print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""


def weighed_alone(reader: str, path: Path) -> tuple[str, int]:
    """What a reader says of a file in a process of its own, and the memory that it took, KiB."""
    command = [sys.executable, "-c", _ALONE, reader, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    *told, most = done.stdout.strip().splitlines()
    return "\n".join(told), int(most.split()[1])


def samples(count: int, links: bool = False, seed: int = 0) -> list[JointSample]:
    """`count` random samples, 1 ms apart."""
    rng = np.random.default_rng(seed)
    result = []
    for i in range(count):
        q, dq, tau = rng.standard_normal((3, len(JOINTS)))
        twist, accel = rng.standard_normal((2, len(LINKS), 6))
        motion = LinkMotion(twist, accel) if links else None
        result.append(JointSample(START_NS + i * STEP_NS, q, dq, tau, motion))
    return result


def record(path: Path, items: list[JointSample], every: int = 100, **options) -> Path:
    """Our own recording, a chunk every `every` samples."""
    links = LINKS if items and items[0].links is not None else ()
    options = {"flush_s": math.inf, **options}  # a busy machine would write a chunk of its own
    with McapWriter(path, JOINTS, links, overwrite=True, **options) as writer:
        for i, sample in enumerate(items, 1):
            writer.write(sample)
            if i % every == 0:
                writer.flush()
    return path


def foreign(
    path: Path,
    messages: list[tuple[int, bytes]],
    topic: str = "/joint_states",
    compression: CompressionType = CompressionType.ZSTD,
    chunking: bool = True,
    schema: str = JOINT_STATE,
    encoding: str = "cdr",
) -> Path:
    """A file of (log time, payload) on one topic by the mcap library."""
    with path.open("wb") as file:
        writer = Writer(file, compression=compression, use_chunking=chunking, chunk_size=4096)
        writer.start(profile="ros2", library="somebody else")
        text = schemas().get(schema, "").encode()
        number = writer.register_schema(schema, "ros2msg", text)
        channel = writer.register_channel(topic, encoding, number)
        for i, (log_time, data) in enumerate(messages):
            writer.add_message(channel, log_time, data, log_time, i)
        writer.finish()
    return path


def payloads(
    items: list[JointSample],
    names=JOINTS,
    fields=("position", "velocity", "effort"),
    stamp=lambda s: s.stamp_ns,
    scale: float = 1.0,
) -> list[tuple[int, bytes]]:
    """JointState messages of the samples, (stamp, bytes)."""
    encoder = JointStateEncoder(names, "base", fields)
    return [(s.stamp_ns, encoder.encode(stamp(s), scale * s.q, scale * s.dq, s.tau)) for s in items]
