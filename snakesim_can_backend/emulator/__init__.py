"""Emulated joint modules: emulated joint modules, which differ from real ones on the bus only by one bit in Identity.

`command`     `snakesim modules`: the emulators of a whole robot as a process on SocketCAN interfaces
`server`      serves one or more buses: handles received frames, sends due ones; also inside another process
`chain`       all modules of a robot, their motors, and the physics model that they move; wall-clock or stepped time
`firmware`    one module: states, watchdog, setpoints, reports; `parameters` is its flash
`module_sensors`  sensor readings, with their noise; `reports` rounds them as the bus does; `frames` are the layouts
`module_slot` a module's place on a bus, and its injected faults
`bus_time`    timing of a bus: arbitration, and load
`faults`      injected faults

Cores are pure: time is passed in, as microseconds since the emulators were started. Imports no MuJoCo: plants are found
by name, among the entry points of `snakesim.physics_models`.
"""
