"""Simulations on MuJoCo's `Batch`: all states in one array, stepped by threads in C, with the C version of the laws.

A batch is bit-identical to a loop, with any number of threads. All models of a batch must give MuJoCo's data the same
sizes, as scenes with equally many obstacles do.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import BackendError
from snakesim_sim_backend.actuators import INPUTS_PER_MOTOR
from snakesim_sim_backend.batch.placed import (
    TOUCH_NUMBERS,
    PlacedRobot,
    find_contact_slice,
    view_link_rotations,
)
from snakesim_sim_backend.batch.simulations import (
    NO_CONTACT_ARRAYS,
    NO_MOTORS,
    ContactArrays,
    Mask,
    MotorArrays,
    SimulationBatch,
)
from snakesim_sim_backend.laws.native_laws import (
    CONTACT_COUNT,
    CONTACT_NUMBERS,
    FOOT_NUMBERS,
    MEMORY_NUMBERS,
)
from snakesim_sim_backend.laws.version import FRICTION_INSTANCE
from snakesim_sim_backend.model.build import FREE_DOFS, FREE_QPOS
from snakesim_sim_backend.state.divergence import (
    COMPLETE_STATE,
    MAX_ACCELERATION,
    MAX_POSITION,
    MAX_SPEED,
    DivergenceWatch,
)

PLUGIN = mujoco.mjtObj.mjOBJ_PLUGIN


class BatchedSimulations(SimulationBatch):
    """The states of all robots are rows of a batch."""

    def __init__(self, robot_count: int, joint_count: int, thread_count: int) -> None:
        self._count = robot_count
        self._joints = joint_count
        self._threads = thread_count
        self._placed: list[PlacedRobot | None] = [None] * robot_count
        self._batch: Batch | None = None
        self.motors = [NO_MOTORS] * robot_count

    def load(self, robot_index: int, placed: PlacedRobot) -> bool:
        if self._batch is None:
            self._allocate_batch(placed)
        elif not self._try_model(robot_index, placed):
            return False
        batch = self._require_batch()
        data = placed.data
        self._placed[robot_index] = placed
        self.motors[robot_index] = placed.motors
        mujoco.mj_getState(placed.sim.model, data, batch.state[robot_index], COMPLETE_STATE)
        self._good_states[robot_index] = batch.state[robot_index]
        batch.warning[robot_index] = 0
        self.torque_nm[robot_index] = data.actuator_force[: self._joints]
        self._start_rotations[robot_index] = view_link_rotations(placed)
        self._is_at_start[robot_index] = True
        placed.motors.bind_state(MotorArrays(self, robot_index, batch.bind("history")[robot_index]))
        return True

    def _allocate_batch(self, placed: PlacedRobot) -> None:
        """Allocate the batch for all robots, with the simulation of the first robot in every row.

        Other robots with equal joints and sensors replace their rows later. Attributes are views of the batch's arrays.

        Args:
            placed: The first robot, in its scene at the start of an episode.
        """
        sim = placed.sim
        model = sim.model
        joints = self._joints
        self._steps = sim.steps_per_tick
        self._links = slice(sim.first_link_body, sim.first_link_body + len(sim.link_geoms))
        self._models = [model] * self._count
        batch = Batch(model, self._count, self._threads)
        batch.set_models(self._models)
        self._batch = batch

        # Views of the states, and outputs of a step.
        self._qpos = batch.bind("qpos")
        self._qvel = batch.bind("qvel")
        self.base_pose = self._qpos[:, :FREE_QPOS]
        self.base_velocity = self._qvel[:, :FREE_DOFS]
        self.angle_rad = self._qpos[:, FREE_QPOS : FREE_QPOS + joints]
        self.velocity_rad_s = self._qvel[:, FREE_DOFS : FREE_DOFS + joints]
        self.motor_state = batch.bind("act")
        self.motor_inputs = batch.bind("ctrl")[:, : INPUTS_PER_MOTOR * joints]
        self._qacc = batch.bind("qacc")
        self._all_torques_nm = batch.bind("actuator_force")
        self._rotations = batch.bind("xmat")
        self.torque_nm = np.zeros((self._count, joints))
        self._start_rotations: Floats = np.zeros((self._count, len(sim.link_geoms), 9))
        # Not stepped since it was loaded.
        self._is_at_start: Mask = np.ones(self._count, dtype=np.bool_)

        # What the laws have written into the states.
        plugin_state = batch.bind("plugin_state")
        friction = model.plugin_stateadr[mujoco.mj_name2id(model, PLUGIN, FRICTION_INSTANCE)]
        contact_slice = find_contact_slice(model)
        self._contact_counts = plugin_state[:, friction + CONTACT_COUNT]
        self._obstacle_contact_counts = plugin_state[:, contact_slice.start]
        self._contact_records = plugin_state[:, contact_slice.start + 1 : contact_slice.stop]
        self._contact_records = self._contact_records.reshape(self._count, -1, TOUCH_NUMBERS)

        # The last good states. Contacts come last in a state, and there is room for many more than there are.
        feet = len(sim.link_geoms) + 1
        numbers_before_plugins = batch.state.shape[1] - plugin_state.shape[1]
        self._numbers_before_contacts = (
            numbers_before_plugins + friction + MEMORY_NUMBERS + FOOT_NUMBERS * feet
        )
        self._good_states = np.empty_like(batch.state)

    def _try_model(self, robot_index: int, placed: PlacedRobot) -> bool:
        """Use the model of a robot in its row. Returns False if it has other sizes than the others."""
        sim = placed.sim
        if sim.steps_per_tick != self._steps or sim.first_link_body != self._links.start:
            return False
        models = [*self._models]
        models[robot_index] = sim.model
        try:
            self._require_batch().set_models(models)
        except mujoco.FatalError:
            self._require_batch().set_models(self._models)
            return False
        self._models = models
        return True

    def _require_batch(self) -> Batch:
        assert self._batch is not None, "no robot has been loaded"
        return self._batch

    def step(self, rows: Sequence[int], tick_by_row: Sequence[int]) -> dict[int, str]:
        """Step the physics of some robots through one control period, and restore the states that diverge.

        Args:
            rows: Rows of the robots to step. The other rows are left alone.
            tick_by_row: Number of the control cycle that ends with this step, of every row of the batch, for messages.

        Returns:
            The reason of the divergence by row, for each simulation that has diverged. The state of such a simulation
            is its last good one.
        """
        batch = self._require_batch()
        divergence_reasons: dict[int, str] = {}
        if len(rows) == self._count:
            batch_rows = None  # all rows, in the batch's own notation
            stepped_rows = slice(None)  # the same, as an index of an array
        else:
            batch_rows = np.array(rows)
            stepped_rows = batch_rows
        try:
            batch.step(batch_rows, nstep=self._steps)
        except SimulationError as error:
            for row in error.ids.tolist():
                divergence_reasons[row] = (
                    f"MuJoCo cannot go on at tick {tick_by_row[row]}: {batch.error(row)}"
                )
        self.torque_nm[stepped_rows] = self._all_torques_nm[stepped_rows, : self._joints]
        self._is_at_start[stepped_rows] = False
        is_good = self._find_good_states()  # (robots,)
        if not is_good.all():
            for row in rows:
                if not is_good[row] and row not in divergence_reasons:
                    divergence_reasons[row] = self._restore_diverged_state(row, tick_by_row[row])
        self._store_states()
        return divergence_reasons

    def _store_states(self) -> None:
        """Keep the states as the last good ones, without the room for more contacts than there are."""
        width = self._numbers_before_contacts + CONTACT_NUMBERS * int(self._contact_counts.max())
        self._good_states[:, :width] = self._require_batch().state[:, :width]

    def _find_good_states(self) -> Mask:
        """Return which states are good, by the rule of `DivergenceWatch`."""
        warnings = self._require_batch().warning[:, :, 1]
        return (
            (np.vecdot(self._qpos, self._qpos) < MAX_POSITION**2)
            & (np.vecdot(self._qvel, self._qvel) < MAX_SPEED**2)
            & (np.vecdot(self._qacc, self._qacc) < MAX_ACCELERATION**2)
            & (warnings.sum(axis=1) == 0)
        )

    def _restore_diverged_state(self, robot_index: int, tick: int) -> str:
        """Restore the last good state of a simulation that has diverged, and return the reason of the divergence.

        To find the reason, the step is repeated from the last good state in a separate simulation.

        Args:
            robot_index: Row of the robot.
            tick: Number of the control cycle, for the message.
        """
        placed = self._placed[robot_index]
        assert placed is not None
        batch = self._require_batch()
        model = placed.sim.model
        data = placed.data
        bad_state = batch.state[robot_index].copy()
        batch.state[robot_index] = self._good_states[robot_index]
        mujoco.mj_setState(model, data, batch.state[robot_index], COMPLETE_STATE)
        # Stores the good state of `data`.
        watch = DivergenceWatch(model, data, placed.physics, self._steps)
        mujoco.mj_setState(model, data, bad_state, COMPLETE_STATE)
        data.qacc[:] = self._qacc[robot_index]
        data.warning.number[:] = batch.warning[robot_index, :, 1]
        batch.warning[robot_index] = 0
        try:
            watch.check(tick)
        except BackendError as error:
            return str(error)
        raise AssertionError("a bad state raises")

    def find_obstacle_contacts(self, robots: Mask) -> ContactArrays:
        counts = np.where(robots, self._obstacle_contact_counts, 0.0).astype(np.intp)
        if not counts.any():
            return NO_CONTACT_ARRAYS
        rows = np.repeat(np.arange(self._count), counts)
        numbers = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
        contacts = self._contact_records[rows, numbers]
        links = contacts[:, 0].astype(np.intp)
        rotations = self._rotations[:, self._links][rows, links]
        if self._is_at_start.any():
            rotations = np.where(
                self._is_at_start[rows, None], self._start_rotations[rows, links], rotations
            )
        return ContactArrays(rows, links, contacts[:, 1:], rotations)
