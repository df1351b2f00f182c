"""The backend `odrive`: axes of ODrive controllers, firmware 0.6, by CANSimple on classic CAN.

`backend`   OdriveBackend: settings and checks      `axes`     what a tick says to an axis, and hears
`protocol`  messages as bytes                       `emulator`     emulated axes

All else is in `snakesim_can_backend.can_drives` and `snakesim_drivers.kit`.
Numbers are those of the motor's shaft: turns, A, N·m.
"""
