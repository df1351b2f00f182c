"""`snakesim ros2`: a robot as a node among ROS 2 nodes, through the router of their own rmw_zenoh; no ROS needed here.

`arguments.py` has those, `join.py` the two sessions, `bridge.py` the loop: it reads the robot's keys as a viewer
does, and publishes what they say. `robot_in_ros.py` translates message by message, `frames.py` names and places frames,
`urdf.py` describes the robot, `steering.py` turns /cmd_vel into intents, `joint_commands.py` /joint_commands into
setpoints, which `driving.py` sends under the lease; `relay.py` bounds rates. `operating.py` and `parameters.py` answer
services, each by a `server.py`. Below them `graph.py` knows rmw_zenoh's keys, liveliness tokens and attachments,
`messages.py` and `service_types.py` the layout of each ROS type; rosbags encodes them.

It must not import zenoh (that is `snakesim_hal.network.foreign_network`), and has no way to a robot that others lack.
"""
