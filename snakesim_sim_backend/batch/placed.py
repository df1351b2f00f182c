"""One robot at rest in its scene, before its simulation becomes a row of many."""

from dataclasses import dataclass

import mujoco
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.programs.preflight import decode_backend_settings
from snakesim_sim_backend.actuators import ModelMotors
from snakesim_sim_backend.backend import SimBackend
from snakesim_sim_backend.laws.version import TOUCHES_INSTANCE
from snakesim_sim_backend.model.build import SimModel, build_sim_model
from snakesim_sim_backend.model.tether import TetherRope
from snakesim_sim_backend.physics import PhysicsStepper
from snakesim_sim_backend.state.contacts import ObstacleContactReader
from snakesim_sim_backend.state.divergence import log_mujoco_warnings
from snakesim_sim_backend.state.start import place_and_settle_robot

TOUCH_NUMBERS = 4  # link and force, see `snakesim_native/laws/laws.h`


@dataclass(frozen=True)
class PlacedRobot:
    """A compiled model, and its state at the start of an episode."""

    config: RunConfig
    sim: SimModel
    data: mujoco.MjData
    physics: PhysicsStepper
    motors: ModelMotors  # off
    contact_reader: ObstacleContactReader
    contact_plugin_state: Floats | None  # see `find_contact_slice`; None if the laws run in Python

    def read_obstacle_contacts(self) -> list[list[float]]:
        """Return the contacts with obstacles in the last step: link (0 at the tail) and force in N in the world."""
        plugin_state = self.contact_plugin_state
        if plugin_state is None:
            return [[contact.link, *contact.force_w] for contact in self.contact_reader.read()]
        count = int(plugin_state[0])
        if not count:
            return []
        return plugin_state[1 : 1 + TOUCH_NUMBERS * count].reshape(count, TOUCH_NUMBERS).tolist()


def find_contact_slice(model: mujoco.MjModel) -> slice:
    """Return the part of `plugin_state` with contacts: their number, then TOUCH_NUMBERS values of each."""
    instance = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_PLUGIN, TOUCHES_INSTANCE)
    start = model.plugin_stateadr[instance]
    return slice(start, start + model.plugin_statenum[instance])


def create_settled_robot(config: RunConfig) -> PlacedRobot:
    """Build the scene of a run, place the robot at its start pose, and let it come to rest.

    The order of the calls must be that of `SimBackend.__init__`, so that a robot starts with the same bits.

    Args:
        config: Configuration of the run, with the settings of the simulator.

    Returns:
        The simulation at the start of an episode, with the motors off.

    Raises:
        ConfigError: The settings do not match the robot or the scene.
    """
    log_mujoco_warnings()
    settings = decode_backend_settings(config, SimBackend)
    sim = build_sim_model(config, settings, stores_contacts_in_state=True)
    data = mujoco.MjData(sim.model)
    physics = PhysicsStepper(sim, data)
    motors = ModelMotors(
        sim.model, data, config.robot, config.period_ns * 1e-9, settings.motor_gain_scale
    )
    place_and_settle_robot(sim, data, physics, config, motors, settings.settle_s)
    if settings.tether is not None:
        TetherRope(sim.model, data, settings.tether).tighten()
    # Disable MuJoCo's sensors: the model defines only IMUs, which environments do not read.
    sim.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
    contact_plugin_state = None
    # The C version of the laws is a plugin of MuJoCo, which writes the contacts into its state.
    if sim.laws == "c":
        contact_plugin_state = data.plugin_state[find_contact_slice(sim.model)]
    return PlacedRobot(
        config=config,
        sim=sim,
        data=data,
        physics=physics,
        motors=motors,
        contact_reader=ObstacleContactReader(sim, data, physics.contacts),
        contact_plugin_state=contact_plugin_state,
    )


def view_link_rotations(robot: PlacedRobot) -> np.ndarray:
    """Return a view of the rotations world_from_link of all links, (n_links, 9), row by row."""
    first = robot.sim.first_link_body
    return robot.data.xmat[first : first + len(robot.sim.link_geoms)]
