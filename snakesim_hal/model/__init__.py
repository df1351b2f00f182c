"""Robot, scene and scenario files, checked on reading, and the geometry and physics derived from them.

`files`, `textfiles`, `field_types`   TOML into checked values, with errors that name file, field and range
`robot`, `scene`, `scenario`          the three kinds of file; `plugins` finds backends, controllers, services by name
`injection`, `fault_plan`             fault injection: its vocabulary, and the faults that a scenario plans
`route`, `kinematics`                 geometry of paths and of the chain
`motor`, `thermal`, `plant`           motor and heat models of a joint; shared by simulator and module twins
"""
