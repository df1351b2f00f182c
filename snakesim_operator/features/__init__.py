"""Independent features. No other part of the package imports them, so each may be left out.

`commissioning`   calibration and system identification: `snakesim joints`, `snakesim identify`
`console`         the robot in a web browser: `snakesim console`
`evaluate`        many runs: `snakesim evaluate`, `sweep`, `optimize`
`figures`         figures for papers: `snakesim plot`
`lab`             routers, certificates and units of a lab: `snakesim deploy`
`robots`          URDF import and export: `snakesim robot`
`ros2`            a robot as a ROS 2 node: `snakesim ros2`
"""
