"""SocketCAN behind the HAL: joint modules on a CAN bus, that a controller cannot tell from simulated ones.

`protocol`   ids, states, parameters, and the codec that reads the DBC file in `schemas/can`, the source of every layout
`settings`   what a scenario's [backends.can] section may say
`bus`        one CAN bus: SocketCAN, or python-can's virtual bus where the kernel has no CAN
`twin`       emulated modules: the firmware's behaviour on a real bus, with any plant behind the motors
`driver`     CanBackend, the entry point `can`: samples, enacts and advances, tick by tick
`can_command` is `snakesim can`

Imports the HAL, python-can and cantools, never the simulator, GNC or Zenoh.
"""
