"""Commands for recordings: inspect, export, film and replay them, and record new ones.

`arguments`  the commands' options           `info`     what a recording holds
`play`       plays a recording on Zenoh      `control`  replays its sensors into guidance, navigation and control
`export`     tables, arrays, a dataset       `lerobot`  the LeRobot dataset, of `episodes` and `pictures`
`video`      a film of a run                 `record_command`, `demonstrations`  record a robot
"""
