"""The network: the only package that imports Zenoh.

`session`         a connection over Zenoh; `streams` has its publishers, readers and queries, `connection` opens it
`endpoint`        checks addresses
`local_network`   the same sessions within one process, without Zenoh
`client`          the interface of guidance, navigation and control, independent of the backend; with `feed`, `run_key`
`robot_mismatch`  rejects messages that do not fit the robot
`stop_port`       emergency stops by UDP, without Zenoh; `local_registry` finds the robots of this machine
`foreign_network` raw bytes on the network of another system, such as that of ROS 2 nodes
`private_channel` between a host and the process that started it
"""
