"""What an arm is. Here names of the known robots, light, so that a wrong one is told at once."""

from __future__ import annotations

from pathlib import Path

ROBOT_FILES = ", a .urdf file, an MJCF file (.xml) or a .json model file"
FOLDER = Path(__file__).parent / "robots"


def robot_names() -> tuple[str, ...]:
    """The robots that are known by name."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.urdf")))
