"""A simulated Franka robot behind the real wire protocol (FCI), versions 5 and 10.

`server.FciServer` is the robot; `command` runs it from a shell. Layouts, codes and rules come
from libfranka-common, the libfranka 0.9.2 and 0.21.2 headers and the Franka FCI documentation.
"""
