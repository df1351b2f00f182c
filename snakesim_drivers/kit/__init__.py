"""What every driver of real joints needs besides its protocol.

`drive_backend`   a complete backend around `Drives`: lifecycle, isolation, faults, ages, sensors
`buses`           several buses, each with its drives and, in real time, in a thread of its own
`drive_type`      parameters, checks and buses of a driver type    `mixed`   a robot with drives of several types
`drive_guard`     keeps a drive that stopped by itself off until reset and arming
`braking`         how long drives brake after a fault
`drive_settings`  parameters that every driver type has
`following`       which drives should follow setpoints, which do, and which must be commanded again
`readings`        what the drives measured, with ages              `findings`   faults, each reported once

Imports no bus, host or network.
"""
