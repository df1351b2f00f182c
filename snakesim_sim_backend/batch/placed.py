"""One robot at rest in its scene, before its simulation becomes a row of many."""

from dataclasses import dataclass

import mujoco
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.programs.preflight import backend_settings
from snakesim_sim_backend.actuators import Motors
from snakesim_sim_backend.backend import SimBackend
from snakesim_sim_backend.laws.version import TOUCHES_INSTANCE
from snakesim_sim_backend.model.build import SimModel, build
from snakesim_sim_backend.model.tether import TetherRope
from snakesim_sim_backend.physics import Physics
from snakesim_sim_backend.state.contacts import TouchReader
from snakesim_sim_backend.state.divergence import log_warnings
from snakesim_sim_backend.state.start import place_robot

TOUCH_NUMBERS = 4  # link and force, see `snakesim_native/laws/laws.h`


@dataclass(frozen=True)
class PlacedRobot:
    """A compiled model, and its state at the start of an episode."""

    config: RunConfig
    sim: SimModel
    data: mujoco.MjData
    physics: Physics
    motors: Motors  # off
    touches: TouchReader
    touch_memory: Floats | None  # see `find_touches`; None: the laws run in Python

    def read_touches(self) -> list[list[float]]:
        """Return the contacts with obstacles in the last step: link (0 at the tail) and force in N in the world."""
        memory = self.touch_memory
        if memory is None:
            return [[touch.link, *touch.force_w] for touch in self.touches.read()]
        count = int(memory[0])
        if not count:
            return []
        return memory[1 : 1 + TOUCH_NUMBERS * count].reshape(count, TOUCH_NUMBERS).tolist()


def find_touches(model: mujoco.MjModel) -> slice:
    """Return where the C laws keep touches in `plugin_state`: their number, then TOUCH_NUMBERS of each."""
    instance = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_PLUGIN, TOUCHES_INSTANCE)
    start = model.plugin_stateadr[instance]
    return slice(start, start + model.plugin_statenum[instance])


def place(config: RunConfig) -> PlacedRobot:
    """Build the scene of a run, place the robot at its start pose, and let it come to rest, as `SimBackend` does.

    Args:
        config: configuration of the run, with the settings of the simulator.

    Raises:
        ConfigError: the settings do not match the robot or the scene.
    """
    log_warnings()
    settings = backend_settings(config, SimBackend)
    sim = build(config, settings, keeps_touches=True)
    data = mujoco.MjData(sim.model)
    physics = Physics(sim, data)
    motors = Motors(sim.model, data, config.robot, config.period_ns * 1e-9, settings.motor_gain_scale)
    place_robot(sim, data, physics, config, motors, settings.settle_s)
    if settings.tether is not None:
        TetherRope(sim.model, data, settings.tether).tighten()
    # MuJoCo's own sensors are the IMUs, which no environment observes.
    sim.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
    touch_memory = data.plugin_state[find_touches(sim.model)] if sim.laws == "c" else None
    return PlacedRobot(config, sim, data, physics, motors, TouchReader(sim, data, physics.contacts), touch_memory)


def read_rotations(robot: PlacedRobot) -> np.ndarray:
    """Return a view of the rotations world_from_link of all links, (n_links, 9), row by row."""
    first = robot.sim.first_link_body
    return robot.data.xmat[first : first + len(robot.sim.link_geoms)]
