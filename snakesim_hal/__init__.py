"""The hardware abstraction: everything that a controller and a robot have to agree on.

`messages`, `keys`, `codec`   what is said, where, and how it looks on the wire
`robot`, `scene`, `scenario`  the files that people write, checked on reading
`route`, `kinematics`         geometry of paths and of the chain, shared by all
`backend`, `host`             what a simulator or a driver implements, and the process that runs it
`client`                      what guidance, navigation and control use; it never names a backend

Zenoh is imported here and nowhere else. This package imports no backend, no GNC, no MuJoCo and no CAN.
"""
