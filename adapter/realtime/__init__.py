"""The live process: clock, rings, workers. Other processes read the estimate from here.

>>> from adapter.realtime import SnapshotReader
>>> with SnapshotReader("panda_adapter") as reader:      # doctest: +SKIP
...     snapshot = reader.read()
...     if snapshot.theta_converged:
...         print(snapshot.theta, snapshot.theta_std)
"""

from adapter.realtime.snapshot import Snapshot, SnapshotError, SnapshotReader, SnapshotWriter

__all__ = ["Snapshot", "SnapshotError", "SnapshotReader", "SnapshotWriter"]
