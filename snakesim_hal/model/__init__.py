"""What people write in files, checked on reading, and the geometry and physics that follow from it.

`files`, `textfiles`, `field_types`   TOML into checked values, with errors that name file, field and range
`robot`, `scene`, `scenario`          the three kinds of file; `plugins` finds backends, controllers, services by name
`injection`, `fault_plan`             faults on request: their words, and those that a scenario plans
`route`, `kinematics`                 geometry of paths and of the chain
`motor`, `thermal`, `plant`           what a joint does with a torque; shared by simulator and module twins
"""
