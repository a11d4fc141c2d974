"""Which files and folders are recordings, by their names."""

from __future__ import annotations

from pathlib import Path

RECORDINGS = (".mcap", ".db3", ".bag")
METADATA = "metadata.yaml"  # beside the files of a rosbag2


def is_recording(path: Path) -> bool:
    """Whether the name of a file, packed or not, or a folder's content is a recording's."""
    if path.is_dir():
        return (path / METADATA).is_file()
    plain = path.with_suffix("") if path.suffix in (".gz", ".zst", ".zstd") else path
    return plain.suffix in RECORDINGS
