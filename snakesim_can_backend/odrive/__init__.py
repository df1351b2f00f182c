"""The backend `odrive`: axes of ODrive controllers, firmware 0.6, by CANSimple on classic CAN.

`backend`   OdriveBackend: settings and checks      `axes`     the family: bring-up, questions, set-points, faults
`protocol`  messages as bytes                       `twin`     emulated axes; `command` runs them as a process

All else that a driver needs is in `snakesim_hal.drivers`. Numbers are those of the motor's shaft: turns, A, N·m.
"""
