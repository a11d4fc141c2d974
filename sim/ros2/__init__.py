"""A simulated arm behind ros2_control: joint states and an effort controller, over DDS.

Types and bytes are the library's (Cyclone DDS), written down here once more: the driver's own
encoding is checked against it.
"""
