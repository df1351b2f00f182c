"""The hardware abstraction: the interface contract between controllers and robots.

From the ground up:

`base`       errors, terminal output, processes, file writes, arrays, reproducible arithmetic
`wire`       what crosses the network: quantities, messages, keys, roles, codec
`model`      what people write in files (robot, scene, scenario), its geometry, and kinds and plans of faults
`physics`    heat, motors, hills, the physics-model interface: for simulators, emulated drives and viewers
`backend`    the contract that a simulator or a driver implements
`controller` the base class of controllers, with its observations and commands
`safety`     who may move the robot, by how much, and what stops it; pure
`network`    Zenoh, which nothing else imports: sessions, the client of controllers, the stop port
`faults`     carries out injected faults, where they are allowed
`run_log`    the host's log of a run
`service`    the contract of guidance, navigation, control and custom services, and the loop around each
`host`       the process that owns a robot: its loop and its latch
`programs`   the programs of a run, and a run in a single process

Each imports only those listed above it. No backend, no GNC, no MuJoCo and no CAN is imported here.
"""
