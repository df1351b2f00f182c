"""The user interface: the `snakesim` command.

From the ground up:

`results`   reads a run's record: record, summary, report, compare
`tools`     commands on running robots: status, echo, arm, estop, fault; and schemas, completion
`run`       `snakesim run`: starts, monitors and ends a run's processes
`ros2`      a robot as a ROS 2 node
`cli`       the command line, put together from the `arguments` of each room; start reading here

Backends, controllers and services are found through entry points, so this package imports the HAL only.
"""
