"""Many simulated robots behind limiters, stepped together: armed, until a fault stops one of them.

Robots in the ordinary state are limited together, by an array limiter. A robot is ordinary while every joint state is
surely plausible, no winding is too hot, and all joints follow commands in one mode. A robot that is not ordinary, and
each robot in the first ticks of its episode, has a limiter of the HAL of its own, in a `LimiterClient`. So no rule of
the safety core is written twice, apart from the limits of targets.
"""

from collections import deque
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from snakesim.environments.array_limiter import (
    LIMIT_NAMES,
    NO_LIMIT,
    LimitArrays,
    Masks,
    MeasuredArrays,
    find_active_limit_indices,
    limit_targets,
    limit_torque_limits,
)
from snakesim.environments.digests import CommandDigests
from snakesim.environments.limiter_client import LimiterClient
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.model.scenario import RunConfig, ServiceSchedule
from snakesim_hal.safety.authority import MAX_REASON_LENGTH
from snakesim_hal.safety.joint_limits import AppliedSetpoints
from snakesim_hal.safety.plausibility import ANGLE_NOISE_MARGIN_RAD, SPEED_MARGIN
from snakesim_hal.wire.messages import Fault, JointMode, RobotDescription
from snakesim_sim_backend.batch.robots import SimulatedRobots

Mask = NDArray[np.bool_]  # (robots,)
ArrayT = TypeVar("ArrayT", bound=NDArray[Any])
# Of the largest plausible jump of an angle: a smaller jump is surely plausible.
SURE_JUMP_FRACTION = 0.99
# Of a velocity or torque from one tick to the next; only NaN and infinity exceed it.
MAX_FINITE_CHANGE = 1e300
MIN_POWER_RATE_HZ = 0.5  # the limiter ignores temperatures that are older than 3 s


def can_arm(config: RunConfig) -> bool:
    """Return whether robots of this configuration can be stepped together."""
    power = config.robot.sensors.power
    has_current_temperatures = power is None or power.rate_hz >= MIN_POWER_RATE_HZ
    return config.backend == "sim" and not config.faults and has_current_temperatures


class _LimiterDecision(NamedTuple):
    """What the array limiter decided in the last tick, and what the decisions are based on."""

    robots: Mask  # which robots the array limiter has limited
    mode: JointMode
    requested: Floats  # (robots, joints), targets of the commands
    target: Floats  # (robots, joints), limited targets
    torque_limit_nm: Floats  # (robots, joints)
    torque_fraction: Floats  # (robots, joints), what derating leaves of each torque limit
    measured: MeasuredArrays


class ArmedRobots:
    """Simulated robots that are stepped together.

    Arrays that are attributes are replaced in each tick, and never change afterwards.

    Attributes:
        simulated: the robots without limiters.
        ticks: (robots,), numbers of the control cycle.
        joints: (robots, 3 * joints), newest angles, velocities and torques.
        is_armed: (robots,), whether the robot obeys commands; False once a fault has stopped it.
        reasons: why each robot is in its state.
        is_limited: (robots, joints), whose target was limited in the last tick.
    """

    def __init__(
        self,
        robot_count: int,
        config: RunConfig,
        description: RobotDescription,
        *,
        safe: bool,
        thread_count: int,
    ) -> None:
        """Allocate the arrays for a number of robots. `start` adds each robot.

        Args:
            robot_count: Number of robots.
            config: Configuration of one robot. All other robots must have the same joints, sensors and rates.
            description: Description of the robot of that configuration.
            safe: If True, targets pass the limiter. If False, the motors get the targets unchanged.
            thread_count: Number of threads that step the physics.
        """
        joints = config.robot.chain.modules
        self.simulation = SimulatedRobots(robot_count, config, thread_count=thread_count)
        self._period_ns = config.period_ns
        self._safe = safe
        self._joint_count = joints

        # State.
        self.ticks: NDArray[np.int64] = np.zeros(robot_count, dtype=np.int64)
        self.joints: Floats = np.zeros((robot_count, 3 * joints))
        self.is_armed: Mask = np.zeros(robot_count, dtype=np.bool_)
        self.reasons = [""] * robot_count
        self._no_limited_joints: Masks = np.zeros((robot_count, joints), dtype=np.bool_)
        self._no_limited_joints.flags.writeable = False  # many ticks share it
        self.is_limited = self._no_limited_joints
        self._active_limits: NDArray[np.int64] = np.zeros((robot_count, joints), dtype=np.int64)
        self._last_decision: _LimiterDecision | None = None
        self._command_digests = CommandDigests(robot_count, joints)

        # Limits.
        self._limits = LimitArrays.allocate(robot_count, joints, config.period_ns * 1e-9)
        # Of angle, velocity and torque in a tick.
        self._max_plausible_change = np.full((robot_count, 3 * joints), MAX_FINITE_CHANGE)
        self._is_temperature_measured = np.ones((robot_count, joints), dtype=np.bool_)
        self._stop_at_c = np.ones((robot_count, joints))
        self._torque_fraction = np.ones((robot_count, joints))
        self._is_derated = False
        self._has_full_torque = False  # whether the torque limits of all robots are the full ones

        # Setpoints of the last tick.
        self._modes: NDArray[np.int8] = np.zeros((robot_count, joints), dtype=np.int8)
        self._target: Floats = np.zeros((robot_count, joints))
        self._torque_limit_nm: Floats = np.zeros((robot_count, joints))
        self._previous_setpoints = (self._modes, self._target, self._torque_limit_nm)

        # Commands, newest last. A limiter uses them some ticks later.
        schedule = config.services.get(CONTROL, ServiceSchedule())
        self._schedule = schedule
        self._commands: deque[Floats] = deque(
            maxlen=max(schedule.latency_ticks, 1) + schedule.decimation
        )

        # Each robot is limited either as a row of arrays, or by a client with a limiter of its own.
        self._limiter_client_by_robot: dict[int, LimiterClient] = {}
        self._is_vectorized: Mask = np.zeros(robot_count, dtype=np.bool_)
        # From the array limiter, until the next `start`.
        self._is_excluded: Mask = np.zeros(robot_count, dtype=np.bool_)
        self._descriptions = [description] * robot_count
        self._all_robots = self.simulation.all_robots

        # Robots that take part in the current ticks. The masks are updated only when the arguments of `step` change.
        self._active: Mask = np.zeros(robot_count, dtype=np.bool_)
        self._active_at_last_call = self._active
        self._active_indices: list[int] = []
        self._active_vectorized: Mask = np.zeros(robot_count, dtype=np.bool_)  # active ones
        self._vectorized_at_last_call = self._is_vectorized

    def can_start(self, config: RunConfig) -> bool:
        """Return whether a robot of this configuration can be stepped together with the other robots."""
        schedule = config.services.get(CONTROL, ServiceSchedule())
        has_equal_schedule = (schedule.latency_ticks, schedule.decimation) == (
            self._schedule.latency_ticks,
            self._schedule.decimation,
        )
        return can_arm(config) and has_equal_schedule and self.simulation.can_simulate(config)

    def start(self, robot_index: int, config: RunConfig, description: RobotDescription) -> bool:
        """Start an episode of a robot: place it in its scene, and arm it.

        Args:
            robot_index: Row of the robot in all arrays.
            config: Configuration of the episode.
            description: Description of the robot of that configuration.

        Returns:
            Whether the robot was started. False if its simulation cannot be stepped together with the other robots.

        Raises:
            ConfigError: The settings do not match the robot or the scene.
            RefusedError: The robot cannot be armed.
        """
        self.stop(robot_index)
        if not self.simulation.load_robot(robot_index, config):
            return False
        self._descriptions[robot_index] = description
        self._load_limits(robot_index)
        self.ticks = _copy_with_row(self.ticks, robot_index, 0)
        self.joints = _copy_with_row(
            self.joints, robot_index, self.simulation.sensors.joints[robot_index]
        )
        self._modes = _copy_with_row(self._modes, robot_index, int(JointMode.PASSIVE))
        self._target = _copy_with_row(self._target, robot_index, 0.0)
        self._torque_limit_nm = _copy_with_row(
            self._torque_limit_nm, robot_index, self._limits.torque_nm[robot_index]
        )
        self._torque_fraction = _copy_with_row(self._torque_fraction, robot_index, 1.0)
        self.is_limited = _copy_with_row(self.is_limited, robot_index, False)
        self._active_limits[robot_index] = NO_LIMIT
        self._has_full_torque = False

        # In the first ticks, a robot always has a limiter of its own. `_observe` moves it to the array limiter later.
        client = LimiterClient(description, safe=self._safe)
        self._pass_samples_to_client(client, robot_index)
        client.arm(self.simulation.make_joint_state(robot_index, 0, self.joints[robot_index]))
        self._limiter_client_by_robot[robot_index] = client
        self._is_excluded[robot_index] = False
        self.is_armed = _copy_with_row(self.is_armed, robot_index, True)
        self.reasons[robot_index] = client.reason
        return True

    def stop(self, robot_index: int) -> None:
        """End the episode of a robot, which takes part in no tick until the next `start`."""
        self._update_active_limits()
        self._command_digests.restart(robot_index)
        self._limiter_client_by_robot.pop(robot_index, None)
        self.is_armed = _copy_with_row(self.is_armed, robot_index, False)
        self._is_vectorized = _copy_with_row(self._is_vectorized, robot_index, False)

    def step(self, mode: JointMode, target: Floats, active: Mask) -> None:
        """Run one tick: limit the commands, step the physics, and read the sensors.

        Commands are computed from the latest samples, without delay, as in lockstep.

        Args:
            mode: Control mode of all joints.
            target: Targets of all joints, (robots, joints), in rad, rad/s or N·m depending on the mode. The array must
                not change afterwards.
            active: Which robots take part, (robots,). They must be armed. The array must not change afterwards, either.
        """
        # The masks are cached: all arrays are replaced, not changed, so that their identity shows whether they are new.
        if (
            active is not self._active_at_last_call
            or self._is_vectorized is not self._vectorized_at_last_call
        ):
            self._update_active_masks(active)
        active_robots = self._active
        vectorized = self._active_vectorized
        # Not a copy: a limiter with latency reads it some ticks later.
        self._commands.append(target)
        self._limit_vectorized(mode, vectorized)
        for robot in self._select_individually_limited(active_robots):
            self._limit_individually(robot, mode, target[robot].tolist())
        self._command_digests.add(
            active_robots, self.ticks, self._modes, self._target, self._torque_limit_nm
        )
        self.simulation.enact(mode, self._target, self._torque_limit_nm, vectorized)
        stepped_robots = self._advance(active_robots)
        self._observe(mode, stepped_robots)

    def _update_active_masks(self, active: Mask) -> None:
        """Update the masks of the robots that are active, and of those among them that the array limiter limits."""
        self._active_at_last_call = active
        self._vectorized_at_last_call = self._is_vectorized
        self._active = self._all_robots if active.all() else active
        self._active_indices = np.flatnonzero(active).tolist()
        vectorized = active & self._is_vectorized
        if not np.array_equal(vectorized, self._active_vectorized):
            self._update_active_limits()
        self._active_vectorized = self._all_robots if vectorized.all() else vectorized

    def _select_individually_limited(self, robots: Mask) -> list[int]:
        """Return the indices of the robots of a mask that have a limiter of their own."""
        if not self._limiter_client_by_robot:
            return []
        return [robot for robot in self._limiter_client_by_robot if robots[robot]]

    def read_digest(self, robot_index: int) -> str:
        """Return the digest of all setpoints, as the `command_digest` of a run."""
        return self._command_digests.read(robot_index)

    def read_active_limits(self) -> NDArray[np.int64]:
        """Return the limit that changed each target in the last tick, (robots, joints), as index in LIMIT_NAMES."""
        self._update_active_limits()
        return self._active_limits

    # --- decisions ---------------------------------------------------------------------------------------------

    def _limit_vectorized(self, mode: JointMode, robots: Mask) -> None:
        """Limit the commands of some robots with the array limiter, and store their setpoints.

        The rows of all other robots keep the setpoints of the last tick. `_limit_individually`, which is called next,
        replaces those of the robots that have a limiter of their own. The modes of the robots here do not change: a
        robot moves to the array limiter only when all its joints follow this mode already.

        Sets `_previous_setpoints`, `_target`, `_torque_limit_nm`, `is_limited` and `_last_decision`.

        Args:
            mode: Control mode of all joints.
            robots: Which robots to limit, (robots,).
        """
        self._previous_setpoints = (self._modes, self._target, self._torque_limit_nm)
        joint_count = self._joint_count
        angles_rad = self.joints[:, :joint_count]
        velocities_rad_s = self.joints[:, joint_count : 2 * joint_count]
        measured = MeasuredArrays(angles_rad, velocities_rad_s)

        # For all robots at once, (robots, joints); the rows of robots that are not in the mask are not used.
        if self._safe:
            requested = self._select_due_commands()
            torque_limit_nm = self._compute_torque_limits_nm()
            target = limit_targets(
                mode, requested, self._target, torque_limit_nm, measured, self._limits
            )
            # Usually no target is limited, and no comparison is needed.
            is_limited = self._no_limited_joints if target is requested else target != requested
            if self._is_derated:
                # A motor that is derated counts as limited, also if its target is not changed.
                full_nm = self._limits.torque_nm
                derated_nm = full_nm * self._torque_fraction
                is_limited = is_limited | (derated_nm < full_nm)
        else:
            requested = self._commands[-1]  # the newest, without latency
            torque_limit_nm = self._limits.torque_nm
            target = requested.copy()
            is_limited = self._no_limited_joints

        # In the usual case the mask is the object `_all_robots`, and no row has to be restored.
        has_other_robots = robots is not self._all_robots
        if has_other_robots:
            is_in_mask = robots[:, None]
            target = np.where(is_in_mask, target, self._target)
            torque_limit_nm = np.where(is_in_mask, torque_limit_nm, self._torque_limit_nm)
            is_limited = is_limited & is_in_mask
            # `_limit_individually` changes rows of this array, and `_previous_setpoints` must keep the old ones.
            self._modes = self._modes.copy()
        self._target = target
        self._torque_limit_nm = torque_limit_nm
        self.is_limited = is_limited
        # Which limit was active is computed from this only when it is needed, by `_update_active_limits`.
        self._last_decision = _LimiterDecision(
            robots, mode, requested, target, torque_limit_nm, self._torque_fraction, measured
        )

    def _select_due_commands(self) -> Floats:
        """Return the commands that take effect in this tick, after the latency of control, (robots, joints)."""
        schedule = self._schedule
        # A controller that runs in every tick: the command of the same age for all robots.
        if schedule.decimation == 1:
            age_ticks = max(schedule.latency_ticks, 1)
            position_from_end = min(age_ticks, len(self._commands))
            return self._commands[-position_from_end]

        # Otherwise the age depends on the tick of the robot, as in `ServiceSchedule.used_output_tick` for the next
        # tick: the newest tick that is due and in which the controller ran.
        due_ticks = np.maximum(self.ticks + 1 - schedule.latency_ticks, 0)
        command_ticks = due_ticks - due_ticks % schedule.decimation
        ages_ticks = self.ticks - command_ticks
        newest_first = np.stack(list(self._commands)[::-1])  # (commands, robots, joints)
        # Outside of the bounds only for robots with their own limiter.
        ages_ticks = np.clip(ages_ticks, 0, len(newest_first) - 1)
        robot_indices = np.arange(len(ages_ticks))
        return newest_first[ages_ticks, robot_indices]

    def _compute_torque_limits_nm(self) -> Floats:
        """Return the torque limits of this tick, (robots, joints): derated, and changed by a limited rate.

        As long as no robot is derated, they are the full limits, and nothing has to be computed.
        """
        full_nm = self._limits.torque_nm
        if self._has_full_torque and not self._is_derated:
            return full_nm
        torque_limit_nm = limit_torque_limits(
            self._torque_limit_nm, self._torque_fraction, self._limits
        )
        self._has_full_torque = np.array_equal(torque_limit_nm, full_nm)
        return torque_limit_nm

    def _limit_individually(self, robot_index: int, mode: JointMode, target: list[float]) -> None:
        """Limit the command of one robot with its own limiter, and pass the setpoints to its motors.

        Args:
            robot_index: Row of the robot.
            mode: Control mode of all joints.
            target: A target for each joint, tail to head.
        """
        client = self._limiter_client_by_robot[robot_index]
        tick = int(self.ticks[robot_index])
        now_ns = tick * self._period_ns
        client.command(tick, now_ns, [mode] * len(target), target)
        client.core.latch_faults_and_expire_lease(now_ns, tick)
        decision = client.core.compute_setpoints(self._schedule.used_output_tick(tick + 1))
        setpoints = decision.setpoints
        self.simulation.enact_one(robot_index, setpoints)
        self._modes[robot_index] = [int(mode) for mode in setpoints.mode]
        self._target[robot_index] = setpoints.target
        self._torque_limit_nm[robot_index] = setpoints.torque_limit_nm
        self._active_limits[robot_index] = NO_LIMIT
        for joint, name in decision.limit_by_joint.items():
            self._active_limits[robot_index, joint] = LIMIT_NAMES.index(name)
        self.is_limited[robot_index] = self._active_limits[robot_index] != NO_LIMIT
        if client.state != "armed":
            self.is_armed = _copy_with_row(self.is_armed, robot_index, False)
            self.reasons[robot_index] = client.reason

    # --- physics and samples -----------------------------------------------------------------------------------

    def _advance(self, active: Mask) -> Mask:
        """Step the physics, sample the sensors, and return the robots whose simulations have not diverged."""
        next_ticks = self.ticks + active
        diverged = self.simulation.advance(self._active_indices, next_ticks.tolist())
        if not diverged:
            self.ticks = next_ticks
            self.simulation.sample(next_ticks, active)
            return active
        moved = active
        for robot, cause in diverged.items():
            moved = _copy_with_row(moved, robot, False)
            self._stop_diverged(robot, cause)
        self.ticks = self.ticks + moved
        self.simulation.sample(self.ticks, moved)
        return moved

    def _stop_diverged(self, robot_index: int, cause: str) -> None:
        """Disarm a robot whose simulation has diverged, as a host does when its backend has failed."""
        cause = cause[:MAX_REASON_LENGTH]
        client = self._limiter_client_by_robot.get(robot_index)
        if client is None:
            self.reasons[robot_index] = cause
        else:
            fault = Fault(
                tick=int(self.ticks[robot_index]), what="backend_failed", cause=cause, scope="robot"
            )
            client.core.latch_fault(fault)
            self.reasons[robot_index] = client.reason
        self.is_armed = _copy_with_row(self.is_armed, robot_index, False)

    def _observe(self, mode: JointMode, moved: Mask) -> None:
        """Check the newest samples of the robots that have moved, and choose a limiter for each robot.

        A robot with an unusual sample gets a limiter of its own. A robot that is ordinary again moves back to the array
        limiter.

        Args:
            mode: Control mode of all joints.
            moved: Which robots have moved in this tick, (robots,).
        """
        joints_before = self.joints
        self.joints = self.simulation.sensors.joints
        if not self._safe:
            for robot in self._select_individually_limited(moved):
                self._move_to_array_limiter(robot)
            return
        self._update_torque_fractions()
        is_plausible, is_ordinary = self._find_ordinary_changes(joints_before)
        for robot in self._select_individually_limited(moved):
            self._pass_samples_to_client(self._limiter_client_by_robot[robot], robot)
            self._is_excluded[robot] |= (
                not is_plausible[robot] or self._limiter_client_by_robot[robot].has_isolated_joints
            )
            if (
                is_ordinary[robot]
                and not self._is_excluded[robot]
                and self._follows_mode(robot, mode)
            ):
                self._move_to_array_limiter(robot)
        if is_ordinary is not self._all_robots:
            unusual = self._active_vectorized & moved & ~is_ordinary
            for robot in np.flatnonzero(unusual).tolist():
                self._move_to_own_client(robot, joints_before[robot], mode)

    def _find_ordinary_changes(self, joints_before: Floats) -> tuple[Mask, Mask]:
        """Find the robots whose newest joint states are surely plausible, and those that are ordinary in addition.

        Args:
            joints_before: Joint states of the tick before, (robots, 3 * joints): angles, velocities and torques.

        Returns:
            Two masks, (robots,). The first one has the robots whose joint states have changed by surely plausible
            amounts. The second one has those among them of which every joint has changed its state, and no winding is
            too hot. If all robots are ordinary, both are the object `self._all_robots`.
        """
        joint_count = self._joint_count
        change = np.abs(self.joints - joints_before)
        is_joint_plausible = change <= self._max_plausible_change
        has_velocity_changed = change[:, joint_count : 2 * joint_count] != 0.0
        windings = self.simulation.sensors.windings
        has_new_temperatures = windings is not None and windings.is_new is not windings.no_robots
        # The usual case: all velocities have changed, so no joint has repeated its state. This saves the reductions.
        are_all_plausible = np.count_nonzero(is_joint_plausible) == is_joint_plausible.size
        have_all_changed = np.count_nonzero(has_velocity_changed) == has_velocity_changed.size
        if are_all_plausible and have_all_changed and not has_new_temperatures:
            return self._all_robots, self._all_robots
        is_plausible: Mask = np.all(is_joint_plausible, axis=1)
        has_joint_changed = np.any(change.reshape(len(change), 3, joint_count) != 0.0, axis=1)
        is_ordinary: Mask = is_plausible & np.all(has_joint_changed, axis=1)
        if windings is not None and has_new_temperatures:
            is_hot = (windings.values >= self._stop_at_c) & self._is_temperature_measured
            is_ordinary = is_ordinary & ~(np.any(is_hot, axis=1) & windings.is_new)
        return is_plausible, is_ordinary

    def _update_torque_fractions(self) -> None:
        """Derate the torque limits of robots whose winding temperatures have just been measured."""
        windings = self.simulation.sensors.windings
        if windings is None or windings.is_new is windings.no_robots:
            return
        fractions = np.where(
            self._is_temperature_measured, self.simulation.remaining_fractions(), 1.0
        )
        self._torque_fraction = np.where(windings.is_new[:, None], fractions, self._torque_fraction)
        self._is_derated = bool((self._torque_fraction < 1.0).any())

    # --- robots that have a limiter of their own ----------------------------------------------------------------

    def _pass_samples_to_client(self, client: LimiterClient, robot_index: int) -> None:
        """Pass the newest samples of one robot to its limiter."""
        tick = int(self.ticks[robot_index])
        now_ns = tick * self._period_ns
        client.core.observe_joints(
            self.simulation.make_joint_state(robot_index, tick, self.joints[robot_index]), now_ns
        )
        windings = self.simulation.sensors.windings
        if windings is not None and windings.is_new[robot_index]:
            power = self.simulation.make_power(robot_index, tick)
            assert power is not None, "a sample has just been delivered"
            client.core.observe_power(power, now_ns)

    def _follows_mode(self, robot_index: int, mode: JointMode) -> bool:
        """Return whether all joints of a robot follow commands in this mode now, and will do so in the next tick."""
        has_commands = self.ticks[robot_index] + 1 >= self._schedule.latency_ticks
        return bool(
            self.is_armed[robot_index]
            and has_commands
            and (self._modes[robot_index] == int(mode)).all()
        )

    def _move_to_array_limiter(self, robot_index: int) -> None:
        """Move a robot from its own limiter to the array limiter, if it is armed."""
        if self.is_armed[robot_index]:
            del self._limiter_client_by_robot[robot_index]
            self._is_vectorized = _copy_with_row(self._is_vectorized, robot_index, True)

    def _move_to_own_client(self, robot_index: int, joints_before: Floats, mode: JointMode) -> None:
        """Move a robot from the array limiter to a limiter of its own, and pass the newest samples to that limiter.

        The new limiter is put into the state that it would have if it had limited the robot before.

        Args:
            robot_index: Row of the robot.
            joints_before: Joint states of the tick before, (3 * joints,): angles, velocities and torques.
            mode: Control mode of all joints.
        """
        tick = int(self.ticks[robot_index])
        client = LimiterClient(self._descriptions[robot_index], safe=True)
        self._limiter_client_by_robot[robot_index] = client
        self._is_vectorized = _copy_with_row(self._is_vectorized, robot_index, False)
        newest_first = list(self._commands)[::-1][:tick]  # only those of this episode
        commands = [
            (tick - 1 - age, target[robot_index].tolist())
            for age, target in enumerate(newest_first)
        ]
        windings = self.simulation.sensors.windings
        power = None
        if windings is not None and not windings.is_new[robot_index]:
            power = self.simulation.make_power(robot_index, tick - 1)
        client.resume(
            self.simulation.make_joint_state(robot_index, tick - 1, joints_before),
            power,
            applied=(
                _read_setpoints(self._previous_setpoints, robot_index),
                _read_setpoints((self._modes, self._target, self._torque_limit_nm), robot_index),
            ),
            commands=commands[::-1],
            mode=mode,
        )
        self._pass_samples_to_client(client, robot_index)

    # --- limits ------------------------------------------------------------------------------------------------

    def _load_limits(self, robot_index: int) -> None:
        """Fill in the limits of a robot from its current description."""
        description = self._descriptions[robot_index]
        joints = self._joint_count
        self._limits.set_robot(robot_index, description)
        speed_rad_s = np.array([joint.speed_limit_rad_s for joint in description.joints])
        max_turn_rad = SPEED_MARGIN * speed_rad_s * description.period_ns * 1e-9
        self._max_plausible_change[robot_index, :joints] = (
            ANGLE_NOISE_MARGIN_RAD + SURE_JUMP_FRACTION * max_turn_rad
        )
        self._is_temperature_measured[robot_index] = [
            "temperature" in joint.measures for joint in description.joints
        ]
        self._stop_at_c[robot_index] = [joint.stop_at_c for joint in description.joints]

    def _update_active_limits(self) -> None:
        """Compute the active limits of the last tick. This is done only when they are read, or would be lost."""
        decision = self._last_decision
        if decision is None:
            return
        self._last_decision = None
        limit_indices = find_active_limit_indices(
            decision.mode,
            decision.requested,
            decision.target,
            decision.torque_limit_nm,
            decision.torque_fraction,
            decision.measured,
            self._limits,
        )
        np.copyto(self._active_limits, limit_indices, where=decision.robots[:, None])


def _copy_with_row(array: ArrayT, robot_index: int, value: object) -> ArrayT:
    """Return a copy of an array in which the row of one robot is replaced."""
    copy = array.copy()
    copy[robot_index] = value
    return copy


def _read_setpoints(
    setpoints: tuple[NDArray[np.int8], Floats, Floats], robot_index: int
) -> AppliedSetpoints:
    """Return the setpoints of one robot from the arrays of modes, targets and torque limits of all robots."""
    modes, target, torque_limit_nm = setpoints
    return AppliedSetpoints(
        modes[robot_index].astype(np.int64), target[robot_index], torque_limit_nm[robot_index]
    )
