"""What every driver of real joints needs besides its protocol.

A driver type implements two interfaces, each in one file:

`drives`          `Drives`: every method that the drives of a bus need, with its arguments, call order and thread
`drive_type`      `DriverTypeBackend`: parameters, checks and buses of a driver type

The rest is the same for all driver types:

`drive_backend`   a complete backend around `Drives`: lifecycle, isolation, faults, sensors
`mixed`           a robot with drives of several types
`drive_settings`  settings that every driver type has
`bus`             one bus with its drives              `threaded_bus`    the same in a thread of its own
`buses`           all buses of a robot
`start_up`        start-up in steps that take seconds, such as homing
`holding_brakes`  when brakes open and close, and how long torque is held
`limit_switches`  faults and motion at the ends of the travel
`drive_guard`     keeps a drive that stopped by itself off until reset and arming
`drive_states`    which drives should follow setpoints, which do, and which must be commanded again
`braking`         how long drives brake after a fault
`readings`        what the drives measured, with ages
`findings`        faults, each reported once

Imports no bus, host or network.
"""
