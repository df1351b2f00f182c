"""SocketCAN behind the HAL: joint modules on a CAN bus, with the same interface to controllers as simulated ones.

`protocol`   ids, states, parameters, and the codec that reads the DBC file in `schemas/can`, the source of every layout
`settings`   the schema of a scenario's [backends.can] section
`bus`        one CAN bus: SocketCAN, or python-can's virtual bus where the kernel has no CAN
`emulator`       emulated modules: the firmware's behavior on a real bus, with any physics model driven by the motors
`driver`     CanBackend, the entry point `can`: samples, enacts and advances, tick by tick
`can_command` is `snakesim drive`

Imports the HAL, python-can and cantools, never the simulator, GNC or Zenoh.
"""
