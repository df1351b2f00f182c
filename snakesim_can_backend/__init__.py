"""SocketCAN behind the HAL: joint modules on a CAN bus, that a controller cannot tell from simulated ones.

`backend`    CanBackend: samples, enacts and advances, tick by tick; the entry point `can`
`settings`   what a scenario's [backends.can] section may say
`protocol`   ids, states, parameters; the DBC file in `schemas/can` is the source of every layout; `codec` reads it
`bus_load`   what a configuration asks of the bus, and the refusal of what does not fit
`wire`       one CAN bus: SocketCAN, or python-can's virtual bus where the kernel has no CAN
`bring_up`   finds every module and checks it, enabling nothing; `watch` says what is wrong with which module
`mocap`      the base's pose from a motion-capture system, by UDP
`twin`       emulated modules: the firmware's behaviour on a real bus, with any plant behind the motors

Imports the HAL, python-can and cantools, never the simulator, GNC or Zenoh.
"""
