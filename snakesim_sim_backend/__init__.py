"""MuJoCo behind the HAL: the simulated robot, with the same interface to controllers as the real one.

`backend`    SimBackend: samples, enacts and advances, tick by tick; the entry point `sim`
`plant`      MujocoPlant: the same body for joint modules that are emulated elsewhere; the entry point `mujoco`
`settings`   the schema of the physics settings
`model`      robot file + scene -> compiled MuJoCo model; `ground` and `obstacles` are its parts
`start`      lays the snake on the ground and lets it come to rest
`actuators`  the motors' modes; `sensors`, `contacts`, `loads` and `pace` what is sampled, and when it is due
`tether`, `truth`, `divergence`  the rope of the static checks, the state without noise, detection of divergence

Imports the HAL and MuJoCo, never guidance, navigation, control or Zenoh. Nothing heavy is imported here.
"""

import os

# Nothing is rendered here. Otherwise MuJoCo would start another Python process to search for a window library: 0.1 s at
# every start, and a traceback if interrupted by Ctrl-C.
os.environ.setdefault("MUJOCO_GL", "off")
