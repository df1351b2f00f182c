"""MuJoCo behind the HAL: the simulated robot, that a controller cannot tell from the real one.

`backend`    SimBackend: samples, enacts and advances, tick by tick; the entry point `sim`
`plant`      MujocoPlant: the same body for joint modules that are emulated elsewhere; the entry point `mujoco`
`settings`   what a scenario may say of the physics
`model`      robot file + scene -> compiled MuJoCo model; `ground` and `obstacles` are its parts
`start`      lays the snake on the ground and lets it come to rest
`actuators`  the motors' modes; `sensors`, `contacts`, `loads` and `pace` what is sampled, and when it is due
`tether`, `truth`, `divergence`  the rope of the static checks, the state without noise, the watch for a blown-up run

Imports the HAL and MuJoCo, never guidance, navigation, control or Zenoh. Nothing heavy is imported here.
"""

import os

# Nothing is drawn here. Otherwise MuJoCo would start a Python of its own, to look for a window library: 0.1 s of every
# start, and a traceback when Ctrl-C meets it.
os.environ.setdefault("MUJOCO_GL", "off")
