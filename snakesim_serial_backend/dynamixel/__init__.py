"""The backend `dynamixel`: servos of Dynamixel's X series, by protocol 2.0, in current-based position mode.

`backend`    DynamixelBackend: settings, checks     `servos`  the driver type: bring-up, reading, setpoints, faults
`packets`    packets as bytes                       `emulator`    emulated servos; `command` runs them as a process
`registers`  the control table, models, units       `load`    bytes and time of a cycle

Numbers are those of the horn: rad, N·m.
"""
