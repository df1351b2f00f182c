"""Robot, scene and scenario files, checked on reading, and the geometry derived from them.

`files`, `textfiles`, `field_types`   TOML into checked values, with errors that name file, field and range
`robot`, `scene`, `scenario`          the three kinds of file; `plugins` finds backends, controllers, services by name
`route`, `kinematics`                 geometry of paths and of the chain
"""
