"""The hardware abstraction: the interface contract between controllers and robots.

From the ground up:

`wire`      what crosses the network: quantities, messages, keys, codec
`injection` the words for faults that are injected
`model`     what people write in files (robot, scene, scenario), and its geometry
`fault_plan`, `plugin_check`   whether a scenario's faults and plug-ins can be
`physics`   heat, motor, plant, hills: for simulators, emulated modules and viewers
`backend`   the one protocol that a simulator or a driver implements
`safety`    who may move the robot, by how much, and what stops it; pure
`network`   Zenoh, and nothing else imports it: sessions, the client of controllers, the stop port
`faults`    carries out injected faults
`host`      the process that owns a robot: its loop, and what it records
`service`   what guidance, navigation and control are, and the loop around each
`conformance`, and the programs `host_process`, `router_process`, `serve`; `in_process` runs all in one process

Each imports only those listed above it. No backend, no GNC, no MuJoCo and no CAN is imported here.
"""
