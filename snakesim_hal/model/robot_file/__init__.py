"""The robot file: what a robot consists of.

`robot`    the whole file, and the description of a robot that is made from it
`joints`   its joints; `links` are the links of a robot that is no row of equal modules
`sensors`  its sensors; `sensor_model` is the base class of their simulation
`checked`  the record of the last start check
"""
