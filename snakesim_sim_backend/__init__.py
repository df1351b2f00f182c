"""MuJoCo behind the HAL: the simulated robot, with the same interface to controllers as the real one.

`backend`        SimBackend: samples, enacts and advances, tick by tick; the entry point `sim`
`physics_model`  MujocoPhysicsModel: the same body for emulated joint modules; the entry point `mujoco`
`settings`       the schema of the physics settings
`physics`        makes physics steps, with the forces of `laws/`
`actuators`      the motors' modes
`model/`         builds the compiled MuJoCo model of a robot in its scene
`laws/`          forces that MuJoCo does not compute: dry friction, flat ground, obstacles that yield
`state/`         start, contacts, loads, exact state, and detection of divergence
`sensors/`       all sensors of the robot; `sensor_service` publishes its cameras from a process of their own, for CAN
`film`           renders pictures of a motion

Imports the HAL and MuJoCo, never guidance, navigation, control or Zenoh. MuJoCo is imported here, before any module of
this package.
"""

from snakesim_sim_backend.quiet_import import import_mujoco

import_mujoco()
