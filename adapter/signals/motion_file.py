"""A planned motion from a file: a table of times and positions, or a JointTrajectory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader

from adapter.model.spatial import Array
from adapter.signals.matching import corresponding
from adapter.signals.source_signals import ALL, ImportSpec, SourceReader
from drivers.errors import DriverError
from drivers.files.mcap.bags import is_recording
from drivers.files.messages import decode
from drivers.files.ros_types import JOINT_TRAJECTORY


def read_motion(path: Path, joint_names: tuple[str, ...]) -> tuple[Array, Array]:
    """Times (m,) s from the first point on and positions (m, n) rad (m where a joint slides).

    Args:
        path: what `adapter excite` writes, any table that has a column of time and one of position
            for each joint (CSV, .npz, .parquet), or an MCAP with trajectory_msgs/JointTrajectory.
        joint_names: (n,) of the arm; other joints of a trajectory are left out.

    Raises:
        DriverError: it cannot be read, lacks a joint, or its time does not go on.
    """
    t, q = _trajectory(path, joint_names) if is_recording(path) else _table(path, joint_names)
    if q.shape != (len(t), len(joint_names)) or len(t) < 2:
        found = f"{q.shape[1]} joints at {len(t)} times"
        raise DriverError(f"{path}: {found}; a motion has {len(joint_names)} at two or more")
    bad = np.flatnonzero(~(np.diff(t) > 0.0) | ~np.isfinite(q[1:]).all(axis=1))
    if bad.size or not np.isfinite(q[0]).all():
        at = int(bad[0]) + 1 if bad.size else 0
        raise DriverError(
            f"{path}: point {at} has no position, or is not later than the one before"
        )
    return t - t[0], q


def _table(path: Path, joint_names: tuple[str, ...]) -> tuple[Array, Array]:
    reader = SourceReader(ImportSpec({ALL: path}), joint_names)
    return reader.need("time")[:, 0], reader.need("q")


def _trajectory(path: Path, joint_names: tuple[str, ...]) -> tuple[Array, Array]:
    """The first one of a recording."""
    try:
        with path.open("rb") as file:
            messages = make_reader(file).iter_messages()
            told = next((m.data for s, _, m in messages if s and s.name == JOINT_TRAJECTORY), None)
    except (OSError, McapError) as error:
        raise DriverError(f"{path}: {error}") from error
    if told is None:
        raise DriverError(f"{path}: has no {JOINT_TRAJECTORY}; a motion is that, or a table")
    fields = decode(JOINT_TRAJECTORY, told)
    have, points = tuple(fields["joint_names"]), fields["points"]
    found, _ = corresponding(joint_names, have, "joint")
    lacking = [name for name, own in zip(joint_names, found, strict=True) if own is None]
    if lacking or not points:
        raise DriverError(f"{path}: moves {', '.join(have)}, not {', '.join(lacking)}")
    since = [point["time_from_start"] for point in points]
    t = np.array([x["sec"] + 1e-9 * x["nanosec"] for x in since])
    q = np.array([point["positions"] for point in points])
    return t, q[:, [have.index(str(name)) for name in found]]
