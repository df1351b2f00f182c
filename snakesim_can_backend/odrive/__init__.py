"""The backend `odrive`: axes of ODrive controllers, firmware 0.6, by CANSimple on classic CAN.

`backend`    OdriveBackend: checks
`settings`   the scenario's section of this driver type
`axes`       what the driver sends to an axis in each control cycle, and how it handles the answers
`protocol`   messages as bytes
`endpoints`  which settings of an axis the driver reads, and their ids
`emulator`   emulated axes

All else is in `snakesim_can_backend.can_drives` and `snakesim_drivers.kit`.
Numbers are those of the motor's shaft: turns, A, N·m.
"""
