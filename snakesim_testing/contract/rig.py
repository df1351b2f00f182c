"""Drives an open backend tick by tick as the HAL host does, through the real authority and its command limiter."""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import msgspec
import numpy as np
import pytest

from snakesim_hal.backend import Backend, SafeSetpoints, Samples
from snakesim_hal.base.arrays import Floats
from snakesim_hal.host.control_cycle import ControlCycle
from snakesim_hal.safety.authority import CommandAuthority
from snakesim_hal.wire.messages import (
    ClockMode,
    EstopRequest,
    Fault,
    JointCommand,
    JointMode,
    JointState,
    LeaseRequest,
    LifecycleRequest,
    LifecycleState,
    make_arm_request,
)
from snakesim_hal.wire.setpoints import RequestedSetpoints
from snakesim_testing.contract import tolerances

JointTargets = Mapping[int, tuple[JointMode, float]]  # joint index -> mode and target
LEASE_HOLDER = "control"
MAX_LATE_PERIODS = 10


def _no_sleep(_seconds: float) -> None:
    """Do not wait, because the time of the drives does not depend on a clock in lockstep."""


def skip_limiter(requested: RequestedSetpoints) -> SafeSetpoints:
    """Return setpoints as safe ones without limiting them, for clauses about the end stops of joints."""
    return SafeSetpoints(requested.mode, requested.target, requested.torque_limit_nm)


@dataclass
class RigRecord:
    """Joint states and setpoints of some ticks. All arrays are (ticks, n_joints)."""

    samples: list[Samples]
    setpoints: list[SafeSetpoints]
    faults: list[Fault]  # reported by the backend in these ticks

    @property
    def joints(self) -> list[JointState]:
        """The joint states, oldest first."""
        return [sample.joints for sample in self.samples]

    @property
    def angle_rad(self) -> Floats:
        """The measured angles."""
        return np.array([joints.angle_rad for joints in self.joints])

    @property
    def velocity_rad_s(self) -> Floats:
        """The measured velocities."""
        return np.array([joints.velocity_rad_s for joints in self.joints])

    @property
    def torque_nm(self) -> Floats:
        """The measured torques."""
        return np.array([joints.torque_nm for joints in self.joints])


@dataclass
class BackendRig:
    """An open backend under test that is driven by the real safety core, without a network."""

    backend: Backend
    clock_mode: ClockMode
    period_ns: int
    must_reopen: bool = False  # unusable for further tests: closed, or a joint is silent
    is_closed: bool = False
    tick: int = 0
    late_periods: float = 0.0  # maximum delay of this machine behind real time
    # The last position target of each joint without velocity mode that follows a speed, by joint index.
    _position_targets_rad: dict[int, float] = field(default_factory=dict[int, float])
    _faults_by_tick: list[tuple[int, Fault]] = field(default_factory=list[tuple[int, Fault]])

    def __post_init__(self) -> None:
        self.robot = self.backend.describe()
        self.joint_count = len(self.robot.joints)
        self.full_torque_nm = [joint.torque_limit_nm for joint in self.robot.joints]
        self._control_cycle = ControlCycle(self.backend, CommandAuthority(self.robot))
        self._sequence = 0
        self._real_time_origin_ns = time.monotonic_ns()
        self._sample_history: list[Samples] = []
        self._setpoint_history: list[SafeSetpoints] = []
        self.first_sample = self._sample()
        # On a bus the first joint states may take a few periods.
        for _ in range(tolerances.ARMING_PERIODS):
            self.wait_periods()
            if all(self.newest_joints.valid):
                break
        self.home_rad = list(self.newest_joints.angle_rad)
        self.faults_at_opening = self.faults

    @property
    def authority(self) -> CommandAuthority:
        """The safety core that drives the robot."""
        return self._control_cycle.safety

    # --- capabilities --------------------------------------------------------------------------------------

    def supports_mode(self, joint_index: int, mode: JointMode) -> bool:
        """Return whether the description of a joint has a mode."""
        return self.robot.joints[joint_index].supports_mode(mode)

    def measures_torque(self, joint_index: int = 0) -> bool:
        """Return whether a joint measures its torque, by its description."""
        return "torque" in self.robot.joints[joint_index].measures

    @property
    def joints_without_watchdog(self) -> list[str]:
        """The joints whose drives do not stop by themselves, by the description."""
        return [joint.name for joint in self.robot.joints if not joint.watchdog]

    def skip_without(self, *modes: JointMode, torque: bool = False) -> None:
        """Skip the clause if joint 0 or 1 does not have these modes, or does not measure its torque.

        Args:
            modes: Modes that the clause uses.
            torque: Whether the clause reads measured torque.
        """
        for joint in (0, 1):
            name = self.robot.joints[joint].name
            for mode in modes:
                if not self.supports_mode(joint, mode):
                    pytest.skip(f"{name} is described without {mode.name.lower()} mode")
            if torque and not self.measures_torque(joint):
                pytest.skip(f"{name} is described without measured torque")

    def _next_position_rad(self, joint_index: int, speed_rad_s: float) -> float:
        """Return the next position target of a joint that follows a speed, for joints without velocity mode."""
        position_rad = self._position_targets_rad.get(
            joint_index, self.newest_joints.angle_rad[joint_index]
        )
        position_rad = position_rad + speed_rad_s * self.period_ns * 1e-9
        self._position_targets_rad[joint_index] = position_rad
        return position_rad

    # --- readings ------------------------------------------------------------------------------------------

    @property
    def faults(self) -> list[Fault]:
        """The faults that the backend has reported since it was opened."""
        return [fault for _, fault in self._faults_by_tick]

    @property
    def newest_joints(self) -> JointState:
        """The newest joint state."""
        return self._sample_history[-1].joints

    def record_since(self, tick: int) -> RigRecord:
        """Return the record of all joint states, setpoints and faults since a tick."""
        first_index = len(self._sample_history) - (self.tick - tick)
        faults = [fault for fault_tick, fault in self._faults_by_tick if fault_tick >= tick]
        return RigRecord(
            self._sample_history[first_index:], self._setpoint_history[first_index - 1 :], faults
        )

    def count_periods(self, seconds: float) -> int:
        """Return the number of periods in a time, rounded up."""
        return int(np.ceil(seconds * 1e9 / self.period_ns))

    # --- one period ----------------------------------------------------------------------------------------

    def enact_without_limiter(self, setpoints: SafeSetpoints, lifecycle: LifecycleState) -> None:
        """Give setpoints to the backend without the command limiter, and let a period pass."""
        self.backend.enact(setpoints, lifecycle)
        self.advance_period(setpoints)

    def advance_period(self, setpoints: SafeSetpoints | None = None) -> None:
        """Let a period pass and sample, as the host does. Faults go to the authority, as in the host."""
        self._setpoint_history.append(setpoints or self._setpoint_history[-1])
        for fault in self._control_cycle.advance():
            self._faults_by_tick.append((self.tick, fault))
        self.tick += 1
        if self.clock_mode == "realtime":
            self._wait_for_deadline()
        self._sample()

    def wait_periods(self, period_count: int = 1) -> RigRecord:
        """Run some control periods without a new command. The last command stays active while its lease lasts.

        Returns:
            The record of these periods.
        """
        first_tick = self.tick
        for _ in range(period_count):
            decision = self._control_cycle.compute_setpoints(self._now_ns, self.tick)
            self._control_cycle.enact(decision)
            self.advance_period(decision.setpoints)
        return self.record_since(first_tick)

    def command_joints(
        self,
        targets: JointTargets,
        period_count: int = 1,
        *,
        torque_limit_nm: list[float] | None = None,
    ) -> RigRecord:
        """Command some joints while the others hold the start pose, through lease, command limiter and lifecycle.

        Args:
            targets: Mode and target by joint index.
            period_count: Number of control periods; the command is sent in each of them.
            torque_limit_nm: Torque limits of all joints. If None, each joint may use its full torque.

        Returns:
            The record of these periods.
        """
        first_tick = self.tick
        for _ in range(period_count):
            self._send(self.make_setpoints(targets, torque_limit_nm))
            self.wait_periods()
        return self.record_since(first_tick)

    def send_command(self, setpoints: RequestedSetpoints) -> RigRecord:
        """Send one command, and return the record of the period after it."""
        first_tick = self.tick
        self._send(setpoints)
        self.wait_periods()
        return self.record_since(first_tick)

    def command_without_limiter(
        self,
        targets: JointTargets,
        period_count: int = 1,
        *,
        torque_limit_nm: list[float] | None = None,
    ) -> RigRecord:
        """Command some joints without the command limiter, which would not drive a joint against its end stop.

        Args:
            targets: Mode and target by joint index.
            period_count: Number of control periods; the command is sent in each of them.
            torque_limit_nm: Torque limits of all joints. If None, each joint may use its full torque.

        Returns:
            The record of these periods.
        """
        first_tick = self.tick
        for _ in range(period_count):
            self._send(self.make_setpoints(dict.fromkeys(targets, (JointMode.PASSIVE, 0.0))))
            self._control_cycle.compute_setpoints(self._now_ns, self.tick)
            self.enact_without_limiter(
                skip_limiter(self.make_setpoints(targets, torque_limit_nm)), self.authority.state
            )
        return self.record_since(first_tick)

    def make_setpoints(
        self, targets: JointTargets, torque_limit_nm: list[float] | None = None
    ) -> RequestedSetpoints:
        """Return setpoints of all joints; those without a command hold the start pose.

        A joint without velocity mode gets a position instead, which moves on at the speed with each call.
        """
        mode = [JointMode.POSITION] * self.joint_count
        target = list(self.home_rad)
        for joint in self._position_targets_rad.keys() - targets.keys():
            del self._position_targets_rad[joint]
        for joint, (joint_mode, joint_target) in targets.items():
            has_velocity_mode = self.supports_mode(joint, JointMode.VELOCITY)
            if joint_mode is JointMode.VELOCITY and not has_velocity_mode:
                joint_mode = JointMode.POSITION
                joint_target = self._next_position_rad(joint, joint_target)
            mode[joint] = joint_mode
            target[joint] = joint_target
        return RequestedSetpoints(mode, target, torque_limit_nm or self.full_torque_nm)

    def freeze_host(
        self, seconds: float, freeze_driver: Callable[[float, Callable[[float], None]], None]
    ) -> None:
        """Let time pass in which the host does nothing, as when its process is stopped and continued later.

        Args:
            seconds: Duration of the freeze.
            freeze_driver: Freezes the driver for a duration in s, with a function that sleeps; see `EmulatedDrives`.
        """
        freeze_driver(seconds, time.sleep if self.clock_mode == "realtime" else _no_sleep)
        self.tick += self.count_periods(seconds)

    # --- the lifecycle -------------------------------------------------------------------------------------

    def arm(self) -> None:
        """Arm the robot at its current pose, and wait until the joint modules are armed. Fails if that is refused."""
        if self.authority.state == "armed":
            return
        if self.authority.state != "disarmed":
            self.disarm()
            self.wait_periods(tolerances.TRANSPORT_PERIODS)
        measured_targets = {
            i: (JointMode.POSITION, angle) for i, angle in enumerate(self.newest_joints.angle_rad)
        }
        self._send(self.make_setpoints(measured_targets))
        response = self.authority.handle_lifecycle_request(
            make_arm_request(self.robot, "conformance"), self._now_ns
        )
        assert response.ok, f"the robot cannot be armed: {response.reason}"
        self.command_joints(measured_targets, tolerances.ARMING_PERIODS)
        self.assert_armed()

    def assert_armed(self) -> None:
        """Fail with the reason if the robot is not armed any more."""
        assert self.authority.state == "armed", (
            f"the robot is no longer armed: {self.authority.reason}"
        )

    def disarm(self) -> None:
        """Disarm an armed robot; reset a robot that was stopped."""
        if self.authority.state == "armed":
            self.authority.handle_lifecycle_request(LifecycleRequest(action="disarm"), self._now_ns)
        else:
            self.reset()

    def reset(self) -> None:
        """Request a reset, which ends a fault or an emergency stop, and the isolation of joints."""
        self.authority.handle_lifecycle_request(LifecycleRequest(action="reset"), self._now_ns)

    def trigger_estop(self) -> None:
        """Trigger an emergency stop."""
        self.authority.handle_estop_request(EstopRequest(requester="bench"), self.tick)

    def report_fault(self) -> None:
        """Report a fault to the authority that the backend itself has not reported."""
        self.authority.latch_fault(
            Fault(tick=self.tick, what="bench", cause="planted by the contract tests")
        )

    @contextlib.contextmanager
    def with_isolation_allowed(self) -> Iterator[None]:
        """Allow the isolation of one failed joint within the context, whatever the robot file allows.

        The robot is disarmed at the begin and at the end of the context.
        """
        usual_cycle = self._control_cycle
        tolerant_authority = CommandAuthority(
            msgspec.structs.replace(self.robot, max_isolated_joints=1)
        )
        self._control_cycle = ControlCycle(self.backend, tolerant_authority)
        self.wait_periods()
        yield
        self.disarm()
        self.wait_periods()
        self._control_cycle = usual_cycle
        self.wait_periods()

    def isolate_joint(self, joint_index: int) -> None:
        """Isolate a joint, by reporting a fault of this joint alone."""
        name = self.robot.joints[joint_index].name
        cause = f"the contract tests isolate {name}"
        self.authority.latch_fault(
            Fault(tick=self.tick, what="bench", cause=cause, joint=name, scope="joint")
        )

    def arm_and_move_joint(self, joint_index: int = 0) -> RigRecord:
        """Arm the robot, and move one joint at constant speed. Fails if the joint does not move.

        Args:
            joint_index: Index of the joint.

        Returns:
            The record of the motion.
        """
        self.arm()
        record = self.command_joints(
            {joint_index: (JointMode.VELOCITY, tolerances.MOTION_SPEED_RAD_S)},
            self.count_periods(tolerances.MOTION_DURATION_S),
        )
        self.assert_armed()
        moved_rad = record.angle_rad[-1, joint_index] - record.angle_rad[0, joint_index]
        assert moved_rad > tolerances.STANDSTILL_RAD, (
            f"joint {joint_index} does not move in velocity mode, so stopping cannot be tested"
        )
        return record

    def return_home(self) -> None:
        """Bring every joint back to the start pose, at rest and disarmed."""
        is_home = self._is_home()
        if self.authority.state == "armed" or not is_home:
            if not is_home:
                self.arm()
                self.command_joints({}, self.count_periods(tolerances.SETTLING_TIME_S))
            self.disarm()
            self.wait_periods(tolerances.TRANSPORT_PERIODS)
        elif self.authority.state != "disarmed":
            self.disarm()
            self.wait_periods()

    def close(self) -> None:
        """Close the backend. A second call is safe."""
        self.must_reopen = True
        self.is_closed = True
        self.backend.close()

    # --- inside --------------------------------------------------------------------------------------------

    @property
    def _now_ns(self) -> int:
        return self.tick * self.period_ns

    def _is_home(self) -> bool:
        deviation_rad = np.abs(np.array(self.newest_joints.angle_rad) - self.home_rad)
        return bool(
            deviation_rad.max() < tolerances.POSITION_TOLERANCE_RAD
            and np.abs(self.newest_joints.velocity_rad_s).max() < tolerances.STANDSTILL_RAD_S
        )

    def _send(self, setpoints: RequestedSetpoints) -> None:
        """Send a command to the authority. The joint states show the clause whether it was rejected."""
        if self.authority.state == "disarmed" and not self.authority.lease.is_held(self._now_ns):
            self.authority.handle_lease_request(
                LeaseRequest(action="acquire", holder=LEASE_HOLDER), self._now_ns
            )
        self._sequence += 1
        command = JointCommand(
            tick=self.tick,
            sequence=self._sequence,
            lease_epoch=self.authority.lease.epoch,
            arm_session=self.authority.arm_session,
            layout=self.robot.layout,
            valid_for_ns=self.robot.lease_ns,
            mode=setpoints.mode,
            target=setpoints.target,
            torque_limit_nm=setpoints.torque_limit_nm,
        )
        self.authority.process_command(command, now_ns=self._now_ns, tick=self.tick, age_ns=0)

    def _sample(self) -> Samples:
        samples = self._control_cycle.sample(self.tick, self._now_ns)
        self._control_cycle.process_samples(samples, self._now_ns)
        self._sample_history.append(samples)
        return samples

    def _wait_for_deadline(self) -> None:
        remaining_ns = self._real_time_origin_ns + self._now_ns - time.monotonic_ns()
        if remaining_ns > 0:
            time.sleep(remaining_ns * 1e-9)
            return
        self.late_periods = max(self.late_periods, -remaining_ns / self.period_ns)
        if -remaining_ns > MAX_LATE_PERIODS * self.period_ns:
            self._real_time_origin_ns -= remaining_ns
