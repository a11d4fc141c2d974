"""Simulated joint boards: an arm of seven Damiao motors in MIT mode on a python-can bus.

Facts of the protocol: openarm_can, LeRobot, DM_Control_Python, OpenArm documentation, Seeed
Studio wiki. Nothing of a driver is used here; only the wire connects the two.
"""
