"""Robot, scene and scenario files, checked on reading, and the geometry derived from them.

`files`, `textfiles`   read TOML into checked values, with errors that name file, field and range
`fields`               describes the fields of files
`robot_file`           the robot file
`scene_file`           the scene file
`scenario`             the scenario file, and the whole configuration of a run
`plugins`              finds backends, controllers and services by name
`fault_kinds`, `fault_plan`   the faults that can be injected, and those that a run has planned
`geometry`             paths, the chain of links, and obstacles
"""
