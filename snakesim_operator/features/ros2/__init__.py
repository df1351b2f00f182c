"""`snakesim start ros2`: a robot as a node among ROS 2 nodes, through the router of their rmw_zenoh; it needs no ROS.

Data flow:
    robot's keys -> `relay` (newest sample, bounded rate) -> `robot_in_ros` (encoding) -> `graph` (ROS topics)
    ROS topics   -> `message_age` (drops old messages)    -> `steering` (intents), `joint_commands` (setpoints)
    ROS services -> `server` (a thread for each service)  -> `operating`, `parameters` (requests to the robot)

`arguments` has the command line. `join` opens the two sessions and runs `bridge`, the loop that reads the robot's
keys as a viewer does. `sensor_topics` has the topics of sensors, `frames` names and places frames, `urdf` describes
the robot. `driving` sends joint commands under the lease, in a thread. `graph` knows rmw_zenoh's keys, liveliness
tokens and attachments; `messages` and `service_types` know the layout of each ROS type, and rosbags encodes them.

This package must not import zenoh (`snakesim_hal.network.foreign_network` does), and reaches a robot only in the ways
that any client has.
"""
