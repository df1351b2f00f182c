"""Many simulated robots behind limiters, stepped together: armed, until a fault stops one of them.

Robots in the ordinary state are limited as arrays. A robot is ordinary while every joint state is plausible beyond
doubt, no winding is too hot, and it obeys commands in one mode. A robot that is not ordinary, and each robot in the
first ticks of its episode, has the limiter of the HAL to itself, in a `LimiterClient`. So no rule of the safety core is
written twice, apart from the limits of targets.
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
    find_active_limits,
    limit_targets,
    limit_torque_limits,
)
from snakesim.environments.digests import CommandDigests
from snakesim.environments.limiter_client import LimiterClient
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.fault_kinds import CONTROL
from snakesim_hal.model.scenario import RunConfig, ServiceSchedule
from snakesim_hal.safety.authority import MAX_REASON_LENGTH
from snakesim_hal.safety.joint_limits import Applied
from snakesim_hal.safety.plausibility import SLACK_RAD, SPEED_MARGIN
from snakesim_hal.wire.messages import Description, Fault, Mode
from snakesim_sim_backend.batch.robots import SimulatedRobots

Mask = NDArray[np.bool_]  # (robots,)
ArrayT = TypeVar("ArrayT", bound=NDArray[Any])
DOUBTLESS = 0.99  # fraction of the largest plausible jump of an angle
MAX_CHANGE = 1e300  # of a finite velocity or torque from one tick to the next
MIN_POWER_RATE_HZ = 0.5  # the limiter ignores temperatures that are older than 3 s


def can_arm(config: RunConfig) -> bool:
    """Return whether robots of this configuration can be stepped together."""
    power = config.robot.sensors.power
    has_current_temperatures = power is None or power.rate_hz >= MIN_POWER_RATE_HZ
    return config.backend == "sim" and not config.faults and has_current_temperatures


class _Decided(NamedTuple):
    """The decisions of the array limiter in the last tick, and what they are based on."""

    robots: Mask
    mode: Mode
    requested: Floats
    target: Floats
    torque_limit_nm: Floats
    torque_fraction: Floats
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

    def __init__(self, robots: int, config: RunConfig, description: Description, *, safe: bool, threads: int) -> None:
        """Make room for robots.

        Args:
            robots: their number.
            config: configuration of one of them; those of the others agree with it in joints, sensors and rates.
            description: the robot of that configuration.
            safe: whether targets pass the limiter.
            threads: number of threads that step the physics.
        """
        joints = config.robot.chain.modules
        self.simulated = SimulatedRobots(robots, config, threads=threads)
        self._period_ns = config.period_ns
        self._safe = safe
        self._joint_count = joints

        # State.
        self.ticks: NDArray[np.int64] = np.zeros(robots, dtype=np.int64)
        self.joints: Floats = np.zeros((robots, 3 * joints))
        self.is_armed: Mask = np.zeros(robots, dtype=np.bool_)
        self.reasons = [""] * robots
        self.is_limited: Masks = np.zeros((robots, joints), dtype=np.bool_)
        self._active_limits: NDArray[np.int64] = np.zeros((robots, joints), dtype=np.int64)
        self._decided: _Decided | None = None
        self._digests = CommandDigests(robots, joints)

        # Limits.
        self._limits = LimitArrays.allocate(robots, joints, config.period_ns * 1e-9)
        self._max_change = np.full((robots, 3 * joints), MAX_CHANGE)  # of angle, velocity and torque in a tick
        self._heat_is_measured = np.ones((robots, joints), dtype=np.bool_)
        self._stop_at_c = np.ones((robots, joints))
        self._torque_fraction = np.ones((robots, joints))
        self._is_derated = False
        self._has_full_torque = False  # whether the torque limits of all robots are the full ones

        # Setpoints of the last tick.
        self._modes: NDArray[np.int8] = np.zeros((robots, joints), dtype=np.int8)
        self._target: Floats = np.zeros((robots, joints))
        self._torque_limit_nm: Floats = np.zeros((robots, joints))
        self._setpoints_before = (self._modes, self._target, self._torque_limit_nm)

        # Commands, newest last. A limiter uses them some ticks later.
        schedule = config.services.get(CONTROL, ServiceSchedule())
        self._schedule = schedule
        self._commands: deque[Floats] = deque(maxlen=max(schedule.latency_ticks, 1) + schedule.decimation)

        # Robots that have a limiter to themselves.
        self._clients: dict[int, LimiterClient] = {}
        self._is_ordinary: Mask = np.zeros(robots, dtype=np.bool_)  # limited as arrays
        self._stays_alone: Mask = np.zeros(robots, dtype=np.bool_)  # until its next reset
        self._descriptions = [description] * robots
        self._all_robots = self.simulated.all_robots

        # Robots that take part in the present ticks.
        self._active: Mask = np.zeros(robots, dtype=np.bool_)
        self._active_at_call = self._active
        self._active_robots: list[int] = []
        self._ordinary: Mask = np.zeros(robots, dtype=np.bool_)  # of the active ones
        self._ordinary_at_call = self._is_ordinary

    def can_start(self, config: RunConfig) -> bool:
        """Return whether a robot of this configuration can be a row."""
        schedule = config.services.get(CONTROL, ServiceSchedule())
        has_equal_schedule = (schedule.latency_ticks, schedule.decimation) == (
            self._schedule.latency_ticks,
            self._schedule.decimation,
        )
        return can_arm(config) and has_equal_schedule and self.simulated.can_simulate(config)

    def start(self, robot: int, config: RunConfig, description: Description) -> bool:
        """Place a robot in its scene, and arm it.

        Args:
            robot: its row.
            config: configuration of its episode.
            description: the robot of that configuration.

        Returns:
            False if its simulation does not fit to the others.

        Raises:
            ConfigError: the settings do not match the robot or the scene.
            RefusedError: the robot cannot be armed.
        """
        self.stop(robot)
        if not self.simulated.place(robot, config):
            return False
        self._descriptions[robot] = description
        self._set_limits(robot)
        self.ticks = _replace(self.ticks, robot, 0)
        self.joints = _replace(self.joints, robot, self.simulated.sensors.joints[robot])
        self._modes = _replace(self._modes, robot, int(Mode.PASSIVE))
        self._target = _replace(self._target, robot, 0.0)
        self._torque_limit_nm = _replace(self._torque_limit_nm, robot, self._limits.torque_nm[robot])
        self._torque_fraction = _replace(self._torque_fraction, robot, 1.0)
        self.is_limited = _replace(self.is_limited, robot, False)
        self._active_limits[robot] = NO_LIMIT
        self._has_full_torque = False

        client = LimiterClient(description, safe=self._safe)
        self._observe_alone(client, robot)
        client.arm(self.simulated.make_joint_state(robot, 0, self.joints[robot]))
        self._clients[robot] = client
        self._stays_alone[robot] = False
        self.is_armed = _replace(self.is_armed, robot, True)
        self.reasons[robot] = client.reason
        return True

    def stop(self, robot: int) -> None:
        """End the episode of a robot. It takes part in no tick until the next `start`."""
        self._update_active_limits()
        self._digests.restart(robot)
        self._clients.pop(robot, None)
        self.is_armed = _replace(self.is_armed, robot, False)
        self._is_ordinary = _replace(self._is_ordinary, robot, False)

    def step(self, mode: Mode, target: Floats, active: Mask) -> None:
        """Run one tick. Commands for the present samples go to the limiters, as a host does it in lockstep.

        Args:
            mode: mode of all joints.
            target: (robots, joints), in rad, rad/s or N·m. It must not change afterwards.
            active: (robots,), which robots take part; they must be armed.
        """
        if active is not self._active_at_call or self._is_ordinary is not self._ordinary_at_call:
            self._choose_robots(active)
        active = self._active
        ordinary = self._ordinary
        self._commands.append(target)
        self._decide_together(mode, ordinary)
        for robot in self._find_clients(active):
            self._decide_alone(robot, mode, target[robot].tolist())
        self._digests.add(active, self.ticks, self._modes, self._target, self._torque_limit_nm)
        self.simulated.enact(mode, self._target, self._torque_limit_nm, ordinary)
        moved = self._advance(active)
        self._observe(mode, moved)

    def _choose_robots(self, active: Mask) -> None:
        """Find the robots that take part in the next ticks."""
        self._active_at_call = active
        self._ordinary_at_call = self._is_ordinary
        self._active = self._all_robots if active.all() else active
        self._active_robots = np.flatnonzero(active).tolist()
        ordinary = active & self._is_ordinary
        if not np.array_equal(ordinary, self._ordinary):
            self._update_active_limits()
        self._ordinary = self._all_robots if ordinary.all() else ordinary

    def _find_clients(self, robots: Mask) -> list[int]:
        """Return those of these robots that have a limiter to themselves."""
        if not self._clients:
            return []
        return [robot for robot in self._clients if robots[robot]]

    def read_digest(self, robot: int) -> str:
        """Return the digest of all setpoints, as the `command_digest` of a run."""
        return self._digests.read(robot)

    def read_active_limits(self) -> NDArray[np.int64]:
        """Return the limit that changed each target in the last tick, (robots, joints), as index in LIMIT_NAMES."""
        self._update_active_limits()
        return self._active_limits

    # --- decisions ---------------------------------------------------------------------------------------------

    def _decide_together(self, mode: Mode, robots: Mask) -> None:
        """Limit the commands of these robots as arrays. The setpoints of the others stay."""
        self._setpoints_before = (self._modes, self._target, self._torque_limit_nm)
        joints = self._joint_count
        measured = MeasuredArrays(self.joints[:, :joints], self.joints[:, joints : 2 * joints])
        if self._safe:
            requested = self._find_commands()
            torque_limit_nm = self._limit_torque_limits()
            target = limit_targets(mode, requested, self._target, torque_limit_nm, measured, self._limits)
            is_limited = target != requested
            if self._is_derated:
                full_nm = self._limits.torque_nm
                is_limited = is_limited | (full_nm > full_nm * self._torque_fraction)
        else:
            requested = self._commands[-1]
            torque_limit_nm = self._limits.torque_nm
            target = requested.copy()
            is_limited = np.zeros_like(self.is_limited)
        if robots is not self._all_robots:
            target = np.where(robots[:, None], target, self._target)
            torque_limit_nm = np.where(robots[:, None], torque_limit_nm, self._torque_limit_nm)
            is_limited = is_limited & robots[:, None]
            self._modes = self._modes.copy()
        self._target = target
        self._torque_limit_nm = torque_limit_nm
        self.is_limited = is_limited
        self._decided = _Decided(robots, mode, requested, target, torque_limit_nm, self._torque_fraction, measured)

    def _find_commands(self) -> Floats:
        """Return the commands that the limiters use in this tick, (robots, joints)."""
        schedule = self._schedule
        if schedule.decimation == 1:
            back = max(schedule.latency_ticks, 1)
            return self._commands[-min(back, len(self._commands))]
        due = np.maximum(self.ticks + 1 - schedule.latency_ticks, 0)
        ages = self.ticks - (due - due % schedule.decimation)
        newest_first = np.stack(list(self._commands)[::-1])
        ages = np.clip(ages, 0, len(newest_first) - 1)  # of the robots that are not ordinary
        return newest_first[ages, np.arange(len(ages))]

    def _limit_torque_limits(self) -> Floats:
        """Return the torque limits of this tick."""
        full_nm = self._limits.torque_nm
        if self._has_full_torque and not self._is_derated:
            return full_nm
        torque_limit_nm = limit_torque_limits(self._torque_limit_nm, self._torque_fraction, self._limits)
        self._has_full_torque = np.array_equal(torque_limit_nm, full_nm)
        return torque_limit_nm

    def _decide_alone(self, robot: int, mode: Mode, target: list[float]) -> None:
        """Let the limiter of one robot decide on its command, and hand the setpoints to its motors."""
        client = self._clients[robot]
        tick = int(self.ticks[robot])
        now_ns = tick * self._period_ns
        client.command(tick, now_ns, [mode] * len(target), target)
        client.core.check_deadlines(now_ns, tick)
        decision = client.core.decide(self._schedule.used_output_tick(tick + 1))
        setpoints = decision.setpoints
        self.simulated.enact_one(robot, setpoints)
        self._modes[robot] = [int(mode) for mode in setpoints.mode]
        self._target[robot] = setpoints.target
        self._torque_limit_nm[robot] = setpoints.torque_limit_nm
        self._active_limits[robot] = NO_LIMIT
        for joint, name in decision.limited.items():
            self._active_limits[robot, joint] = LIMIT_NAMES.index(name)
        self.is_limited[robot] = self._active_limits[robot] != NO_LIMIT
        if client.state != "armed":
            self.is_armed = _replace(self.is_armed, robot, False)
            self.reasons[robot] = client.reason

    # --- physics and samples -----------------------------------------------------------------------------------

    def _advance(self, active: Mask) -> Mask:
        """Step the physics, and return the robots whose simulations go on."""
        following = self.ticks + active
        diverged = self.simulated.advance(self._active_robots, following.tolist())
        if not diverged:
            self.ticks = following
            self.simulated.sample(following, active)
            return active
        moved = active
        for robot, cause in diverged.items():
            moved = _replace(moved, robot, False)
            self._stop_diverged(robot, cause)
        self.ticks = self.ticks + moved
        self.simulated.sample(self.ticks, moved)
        return moved

    def _stop_diverged(self, robot: int, cause: str) -> None:
        """React to a simulation that has failed, as a host reacts to a backend that has failed."""
        cause = cause[:MAX_REASON_LENGTH]
        client = self._clients.get(robot)
        if client is None:
            self.reasons[robot] = cause
        else:
            fault = Fault(tick=int(self.ticks[robot]), what="backend_failed", cause=cause, reach="robot")
            client.core.fault(fault)
            self.reasons[robot] = client.reason
        self.is_armed = _replace(self.is_armed, robot, False)

    def _observe(self, mode: Mode, moved: Mask) -> None:
        """Let the limiters judge the newest samples of the robots that have moved."""
        before = self.joints
        self.joints = self.simulated.sensors.joints
        if not self._safe:
            for robot in self._find_clients(moved):
                self._join_others(robot)
            return
        self._update_torque_fractions()
        is_near, is_ordinary = self._find_ordinary(before)
        for robot in self._find_clients(moved):
            self._observe_alone(self._clients[robot], robot)
            self._stays_alone[robot] |= not is_near[robot] or self._clients[robot].has_isolated_joints
            if is_ordinary[robot] and not self._stays_alone[robot] and self._obeys(robot, mode):
                self._join_others(robot)
        if is_ordinary is not self._all_robots:
            unusual = self._ordinary & moved & ~is_ordinary
            for robot in np.flatnonzero(unusual).tolist():
                self._leave_others(robot, before[robot], mode)

    def _find_ordinary(self, before: Floats) -> tuple[Mask, Mask]:
        """Compare the newest joint states with those before.

        Returns:
            The robots whose joint states are surely plausible changes; and those among them of which no joint has
            repeated its state, and no winding is too hot.
        """
        joints = self._joint_count
        change = np.abs(self.joints - before)
        is_near = change <= self._max_change
        has_moved = change[:, joints : 2 * joints] != 0.0
        windings = self.simulated.sensors.windings
        is_heat_new = windings is not None and windings.is_new is not windings.no_robots
        all_near = np.count_nonzero(is_near) == is_near.size
        if all_near and np.count_nonzero(has_moved) == has_moved.size and not is_heat_new:
            return self._all_robots, self._all_robots
        near: Mask = np.all(is_near, axis=1)
        has_changed: Mask = np.all(np.any(change.reshape(len(change), 3, joints) != 0.0, axis=1), axis=1)
        ordinary: Mask = near & has_changed
        if windings is not None and is_heat_new:
            is_hot = (windings.values >= self._stop_at_c) & self._heat_is_measured
            ordinary = ordinary & ~(np.any(is_hot, axis=1) & windings.is_new)
        return near, ordinary

    def _update_torque_fractions(self) -> None:
        """Derate the torque limits of robots whose winding temperatures have just been measured."""
        windings = self.simulated.sensors.windings
        if windings is None or windings.is_new is windings.no_robots:
            return
        fractions = np.where(self._heat_is_measured, self.simulated.remaining_fractions(), 1.0)
        self._torque_fraction = np.where(windings.is_new[:, None], fractions, self._torque_fraction)
        self._is_derated = bool((self._torque_fraction < 1.0).any())

    # --- robots that have a limiter to themselves --------------------------------------------------------------

    def _observe_alone(self, client: LimiterClient, robot: int) -> None:
        """Pass the newest samples of one robot to its limiter."""
        tick = int(self.ticks[robot])
        now_ns = tick * self._period_ns
        client.core.observe(self.simulated.make_joint_state(robot, tick, self.joints[robot]), now_ns)
        windings = self.simulated.sensors.windings
        if windings is not None and windings.is_new[robot]:
            power = self.simulated.make_power(robot, tick)
            assert power is not None, "a sample has just been delivered"
            client.core.observe_power(power, now_ns)

    def _obeys(self, robot: int, mode: Mode) -> bool:
        """Return whether all joints of a robot follow commands of this mode, and will in the next tick."""
        has_commands = self.ticks[robot] + 1 >= self._schedule.latency_ticks
        return bool(self.is_armed[robot] and has_commands and (self._modes[robot] == int(mode)).all())

    def _join_others(self, robot: int) -> None:
        """Limit a robot together with the others from now on."""
        if self.is_armed[robot]:
            del self._clients[robot]
            self._is_ordinary = _replace(self._is_ordinary, robot, True)

    def _leave_others(self, robot: int, before: Floats, mode: Mode) -> None:
        """Give a robot a limiter to itself, and let that judge the newest samples.

        Args:
            robot: its row.
            before: (3 * joints,), the joint states of the tick before.
            mode: the mode of all joints.
        """
        tick = int(self.ticks[robot])
        client = LimiterClient(self._descriptions[robot], safe=True)
        self._clients[robot] = client
        self._is_ordinary = _replace(self._is_ordinary, robot, False)
        newest_first = list(self._commands)[::-1][:tick]
        commands = [(tick - 1 - age, target[robot].tolist()) for age, target in enumerate(newest_first)]
        windings = self.simulated.sensors.windings
        power = None
        if windings is not None and not windings.is_new[robot]:
            power = self.simulated.make_power(robot, tick - 1)
        client.resume(
            self.simulated.make_joint_state(robot, tick - 1, before),
            power,
            applied=(
                _read_setpoints(self._setpoints_before, robot),
                _read_setpoints((self._modes, self._target, self._torque_limit_nm), robot),
            ),
            commands=commands[::-1],
            mode=mode,
        )
        self._observe_alone(client, robot)

    # --- limits ------------------------------------------------------------------------------------------------

    def _set_limits(self, robot: int) -> None:
        """Use the limits of a robot's present description."""
        description = self._descriptions[robot]
        joints = self._joint_count
        self._limits.set_robot(robot, description)
        speed_rad_s = np.array([joint.speed_limit_rad_s for joint in description.joints])
        max_turn_rad = SPEED_MARGIN * speed_rad_s * description.period_ns * 1e-9
        self._max_change[robot, :joints] = SLACK_RAD + DOUBTLESS * max_turn_rad
        self._heat_is_measured[robot] = ["temperature" in joint.measures for joint in description.joints]
        self._stop_at_c[robot] = [joint.stop_at_c for joint in description.joints]

    def _update_active_limits(self) -> None:
        """Find the names of the limits of the last tick. That is done only when they are read, or would be lost."""
        decided = self._decided
        if decided is None:
            return
        self._decided = None
        names = find_active_limits(
            decided.mode,
            decided.requested,
            decided.target,
            decided.torque_limit_nm,
            decided.torque_fraction,
            decided.measured,
            self._limits,
        )
        np.copyto(self._active_limits, names, where=decided.robots[:, None])


def _replace(array: ArrayT, robot: int, value: object) -> ArrayT:
    """Return a copy of an array with another row."""
    copy = array.copy()
    copy[robot] = value
    return copy


def _read_setpoints(setpoints: tuple[NDArray[np.int8], Floats, Floats], robot: int) -> Applied:
    """Return the setpoints of one robot."""
    modes, target, torque_limit_nm = setpoints
    return Applied(modes[robot].astype(np.int64), target[robot], torque_limit_nm[robot])
