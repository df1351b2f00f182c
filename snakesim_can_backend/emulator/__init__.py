"""Emulated joint modules. On the bus they differ from real ones only by one bit in Identity.

`command`         `snakesim drive emulate can`: the emulators of a whole robot as a process on SocketCAN interfaces
`server`          serves one or more buses; also inside another process
`chain`           all modules of a robot, their motors, and the physics model; wall-clock or stepped time
`module_slot`     a module's place on a bus: node id, joint, and injected faults
`firmware`        one module: states, watchdog, setpoints, reports
`parameters`      a module's parameters, and its flash
`module_sensors`  sensor readings, with their noise
`frames`          frame layouts, and the rounding of measurements to the steps of the bus
`bus_time`        timing of a bus: arbitration, and load
`faults`          injected faults, as text

Everything but `command` and `server` is pure: time is passed in, as microseconds since the emulators were started. The
folder imports no MuJoCo: physics models are found by name, among the entry points of `snakesim.physics_models`.
"""
