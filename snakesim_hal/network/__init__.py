"""The network; the only home of Zenoh.

`session`         publishers, readers and questions on Zenoh; `endpoint`, `mailbox`, `run_key` beside it
`local_network`   the same sessions within one process, without Zenoh
`client`          what guidance, navigation and control use; it never names a backend
`robot_mismatch`  messages that decode, but do not fit the robot
`stop_port`       emergency stops by UDP, beside Zenoh; `local_registry` finds the robots of this machine
`private_channel` between a host and the process that started it
"""
