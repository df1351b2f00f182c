"""Robot, scene and scenario files, checked on reading, and the geometry derived from them.

`files`, `textfiles`, `field_types`   read TOML into checked values, with errors that name file, field and range
`robot`, `joints`, `sensors`          the robot file; `checked` is its record of the last start check
`sensor_model`                        base class of the simulation of a sensor on a link
`scene`, `solids`, `random_field`     the scene file; `fitting` scales a scene to another robot
`placement`                           the obstacles of a scene at their places
`scenario`                            the scenario file, and the whole configuration of a run
`plugins`                             finds backends, controllers and services by name
`fault_kinds`, `fault_plan`           the faults that can be injected, and those that a run has planned
`route`, `kinematics`, `outlines`     geometry of paths, of the chain and of obstacles
"""
