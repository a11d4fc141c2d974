"""An arm that ros2_control drives, over DDS and without ROS: states in, torques out.

arm        the driver, in the loop's process
bridge     the process that is on the network: states, commands, brake
memory     what the two share
holding    how a moving arm is braked and held by torques
wire       DDS with the types and names that ROS 2 uses
settings   what an address says
"""
