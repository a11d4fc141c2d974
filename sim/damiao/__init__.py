"""Simulated joint boards: an arm of seven Damiao motors in MIT mode on a python-can bus.

Facts of the protocol: openarm_can, LeRobot, DM_Control_Python, OpenArm documentation, Seeed
Studio wiki. Nothing of a driver is used here; only the wire connects the two.
"""

from sim.damiao.boards import Boards
from sim.damiao.faults import Faults
from sim.damiao.host_bus import FailingBus, ServedBus
from sim.damiao.line import Line

__all__ = ["Boards", "FailingBus", "Faults", "Line", "ServedBus"]
