"""The backend `moteus`: mjbots' controllers, by registers on CAN FD.

`backend`      MoteusBackend: checks
`settings`     the scenario's section of this driver type
`controllers`  what the driver sends to a controller in each control cycle, and how it handles the answers
`protocol`     registers and frames as bytes
`emulator`     emulated controllers

All else is in `snakesim_can_backend.can_drives` and `snakesim_drivers.kit`.
Numbers are those of the controller's output shaft: turns, turns/s, N·m.
"""
