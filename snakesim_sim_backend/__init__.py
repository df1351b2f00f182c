"""MuJoCo behind the HAL: the simulated robot, with the same interface to controllers as the real one.

`backend`        SimBackend: samples, enacts and advances, tick by tick; the entry point `sim`
`physics_model`  MujocoPhysicsModel: the same body for emulated joint modules; the entry point `mujoco`
`settings`       the schema of the physics settings
`model`          builds the compiled MuJoCo model; `ground`, `obstacles`, `surface` and `imu` add its parts
`start`          puts the snake on the ground and lets it come to rest
`physics`        makes physics steps, with the forces of `flat_ground`, `contact_friction`, `yielding` and `chain`
`actuators`      the motors' modes; `contacts` and `loads` what touches the links
`sensors/`       all sensors of the robot; `sensor_service` publishes its cameras from a process of their own, for CAN
`tether`         the rope of the static checks; `truth` the state without noise; `divergence` its detection
`film`           renders pictures of a motion

Imports the HAL and MuJoCo, never guidance, navigation, control or Zenoh. MuJoCo is imported here, before any module of
this package.
"""

from snakesim_sim_backend.quiet_import import import_mujoco

import_mujoco()
