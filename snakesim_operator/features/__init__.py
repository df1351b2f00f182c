"""Independent features. No other part of the package imports them, so each may be left out.

`commissioning`   calibration and system identification: `snakesim robot calibrate`, `snakesim robot identify`
`console`         the robot in a web browser: `snakesim console`
`evaluate`        many runs: `snakesim study evaluate`, `sweep`, `optimize`
`figures`         figures for papers: `snakesim recording plot`
`lab`             routers, certificates and units of a lab: `snakesim lab`
`robots`          URDF import and export: `snakesim robot`
`ros2`            a robot as a ROS 2 node: `snakesim start ros2`
"""
