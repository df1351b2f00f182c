"""Module twins: emulated joint modules that a host cannot tell from real ones, but for a bit that says so.

`command`     `snakesim modules`: the twins of a whole robot as a process on SocketCAN interfaces
`server`      one or more buses, served: what arrives is handled, what is due is sent; also inside another process
`chain`       all modules of a robot, their motors, and the plant that they move; wall-clock or stepped time
`firmware`    one module: states, watchdog, set-points, reports; `parameters` is what it keeps in its flash
`motors`      all motors as vectors; their heat is `snakesim_hal.model.thermal`
`senses`      what the sensors feel, with their noise; `reports` rounds it as the bus does; `frames` are the layouts
`slot`        a module's place on a bus, and what is wrong there
`bus_time`    what a bus of 1 Mbit/s would make of the frames: who waits for whom, and how full it is
`faults`      what can go wrong, on request
`inertia`     a plant for machines without physics: every joint an inertia of its own

Cores are pure: time is passed in, as microseconds since the twins were started. Imports no MuJoCo: plants are found by
name, among the entry points of `snakesim.plants`.
"""
