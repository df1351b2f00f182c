"""MuJoCo behind the HAL: the simulated robot, with the same interface to controllers as the real one.

`backend`    SimBackend: samples, enacts and advances, tick by tick; the entry point `sim`
`physics_model`      MujocoPhysicsModel: the same body for joint modules that are emulated elsewhere; the entry point
`mujoco`
`settings`   the schema of the physics settings
`model`      robot file + scene -> compiled MuJoCo model; `ground` and `obstacles` are its parts
`start`      lays the snake on the ground and lets it come to rest
`actuators`  the motors' modes; `contacts` and `loads` what touches the links
`sensors/`   everything that the robot senses; `sensor_service` its cameras in a process of their own, for CAN
`tether`, `truth`, `divergence`  the rope of the static checks, the state without noise, detection of divergence

Imports the HAL and MuJoCo, never guidance, navigation, control or Zenoh. MuJoCo is imported here, before any module of
this package.
"""

from snakesim_sim_backend.quiet_import import import_mujoco

import_mujoco()
