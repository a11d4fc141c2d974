"""A Franka Panda/FER (FCI protocol 5) or FR3 (protocol 10), over the network."""

from drivers.fci.arm import FciArm

__all__ = ["FciArm"]
