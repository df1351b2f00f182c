"""MuJoCo behind the HAL: the simulated robot, with the same interface to controllers as the real one.

`backend`    SimBackend: samples, enacts and advances, tick by tick; the entry point `sim`
`plant`      MujocoPlant: the same body for joint modules that are emulated elsewhere; the entry point `mujoco`
`settings`   the schema of the physics settings
`model`      robot file + scene -> compiled MuJoCo model; `ground` and `obstacles` are its parts
`start`      lays the snake on the ground and lets it come to rest
`actuators`  the motors' modes; `contacts` and `loads` what touches the links
`sensors/`   everything that the robot senses; `sensor_service` its cameras in a process of their own, for CAN
`tether`, `truth`, `divergence`  the rope of the static checks, the state without noise, detection of divergence

Imports the HAL and MuJoCo, never guidance, navigation, control or Zenoh. Nothing heavy is imported here.
"""

import os

# Nothing is shown on a screen. Otherwise MuJoCo would start another Python process to search for a window library:
# 0.1 s at every start, and a traceback if interrupted by Ctrl-C. Cameras that render open what they need themselves.
os.environ.setdefault("MUJOCO_GL", "off")
