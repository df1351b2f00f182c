"""A whole backend around the drives of a robot. A driver type implements `drives.Drives`; all else is here.

In each control cycle every drive is read, and then gets its setpoint, which holds until the next one. All numbers
between here and the drives are those at the drives' shafts, in SI units.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import msgspec
import numpy as np

from snakesim_drivers.kit.braking import BrakingJoints
from snakesim_drivers.kit.drive_guard import NO_DRIVES, RESET_GRACE_CYCLES
from snakesim_drivers.kit.drive_probe import DriveProbe
from snakesim_drivers.kit.drives import BusCommand, Drives
from snakesim_drivers.kit.findings import FaultFinding, ReportedFindings
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_drivers.motion_capture.mocap import MocapReceiver
from snakesim_hal.backend import Backend, SafeSetpoints, Samples
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_hal.model.robot_file.robot import add_drive_identities
from snakesim_hal.model.scenario import RunConfig, describe_run_robot
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Fault,
    JointMode,
    LifecycleState,
    Message,
    RobotDescription,
    SensorDescription,
)

LATCHED_STATES = ("fault", "estop")  # only the operator's reset ends them
MIN_UNANSWERED_REQUESTS = 3  # unanswered ones: a single lost answer is no fault
# One round requests the health of each drive once. After so many rounds without a response it is unknown.
MAX_HEALTH_AGE_ROUNDS = 3


class DriverClock:
    """The time of a driver: a steady clock, or in lockstep the robot's own time, which `DriveBackend` sets."""

    def __init__(self, config: RunConfig) -> None:
        self._lockstep = config.clock_mode == "lockstep"
        self.robot_time_ns = 0
        self._start_up_duration_ns = 0  # that has passed before the robot's time began

    def now_ns(self) -> int:
        """Return the current time in ns."""
        return (
            self.robot_time_ns + self._start_up_duration_ns
            if self._lockstep
            else time.monotonic_ns()
        )

    def advance_start_up_time(self, duration_ns: int) -> None:
        """Advance the driver's time in lockstep while drives start up: the robot's own time is paused until arming."""
        self._start_up_duration_ns += duration_ns


@dataclass(frozen=True, kw_only=True)
class DriveBackendParts:
    """What a subclass of `DriveBackend` passes to its constructor."""

    name: str  # of the backend
    hardware: str  # what the backend drives, such as can0+can1; empty if the drives are emulated
    clock: DriverClock
    # Receives the base pose; None without motion capture. The backend closes it.
    mocap: MocapReceiver | None
    # Opens the buses; raises ConfigError and BackendError.
    open_drives: Callable[[DriveReadings], Drives]
    watchdog_timeouts_s: Sequence[float]  # time of each joint's watchdog, from tail to head
    decimation: int = 1  # control cycles from one reading of the slowest bus to the next
    # Joints whose drives do not stop by themselves.
    joints_without_watchdog: frozenset[int] = NO_DRIVES


class DriveBackend(Backend):
    """A backend on drives. The hooks at the end are for driver types that need more."""

    # After a reset, in which drives may report older errors.
    reset_grace_cycles: ClassVar[int] = RESET_GRACE_CYCLES
    # True: packets of any program keep a drive on after its host died.
    polling_feeds_watchdog: ClassVar[bool] = False

    @classmethod
    def open_probe(cls, config: RunConfig, settings: Any) -> DriveProbe:
        """Open a second program on the bus of the first joint's drive, which only reads.

        `snakesim drive qualify` uses it. A driver type without a probe raises ConfigError, as the default does.

        Args:
            config: Configuration of the run.
            settings: An instance of `Settings`, which names the bus.

        Raises:
            ConfigError: The driver type has no probe.
            BackendError: The bus cannot be opened.
        """
        del config, settings
        raise ConfigError(
            f"{cls.__name__} has no `open_probe`, so no second program can read its drives; see "
            f"docs/hardware/write-a-driver.md",
            code="drive/unsupported-setting",
        )

    def __init__(self, config: RunConfig, parts: DriveBackendParts) -> None:
        """Open the buses and bring up every drive; no drive is enabled.

        Args:
            config: Configuration of the run, with robot, lease and safety settings.
            parts: What differs between driver types: the function that opens the drives, the clock, motion capture,
                and watchdog timeouts.

        Raises:
            ConfigError: The configuration does not suit the drives.
            BackendError: A bus cannot be opened, or a drive is missing.
        """
        joints = config.robot.joint_table
        # Configuration.
        self._joint_names = [joint.name for joint in joints]
        self._max_isolated_joint_count = config.robot.safety.max_isolated_joints
        self._period_ns = config.period_ns
        self._lease_ns = config.lease_ns
        self._decimation = parts.decimation
        # Measurements.
        self._clock = parts.clock
        self._mocap = parts.mocap
        self._readings = DriveReadings(joints, parts.clock.now_ns)
        self._mounting = self._readings.mounting
        # Lifecycle.
        self._is_open = True
        self._tick = 0
        self._lifecycle: LifecycleState = "disarmed"
        self._driven_joints = NO_DRIVES  # joints whose drives got setpoints in the newest cycle
        self._braking = BrakingJoints(
            [round(watchdog_s * 1e9) for watchdog_s in parts.watchdog_timeouts_s],
            is_hold_mode=config.robot.safety.action == "hold",
        )
        # Faults.
        self._reported_findings = ReportedFindings()
        # Isolated joints have failed, and the robot continues without them until a reset.
        self._isolated_joints = NO_DRIVES
        # Joints that were reported as failed since the newest setpoints: the HAL should isolate them.
        self._joints_awaiting_isolation = NO_DRIVES
        # Left, in which drives may report errors from before a reset.
        self._remaining_grace_cycles = 0
        try:
            self._drives = parts.open_drives(self._readings)
        except BaseException:
            if parts.mocap is not None:
                parts.mocap.close()
            raise
        try:
            self._drives.bring_up()
        except BaseException:
            self.close()
            raise
        description = self._make_description(config, parts.name, parts.hardware)
        description = add_drive_identities(
            description, self._readings.serials, self._readings.firmware
        )
        self._description = _mark_missing_watchdogs(description, parts.joints_without_watchdog)

    def describe(self) -> RobotDescription:
        """Return the robot of the robot file, with the sensors and serial numbers of its drives."""
        return self._description

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """Read all drives and return what they measure."""
        self._require_open()
        self._tick = tick
        self._clock.robot_time_ns = timestamp_ns
        self._remaining_grace_cycles -= 1
        self._readings.start_request()
        self._drives.read()
        return self._make_samples(tick, timestamp_ns)

    def enact(self, setpoints: SafeSetpoints, lifecycle: LifecycleState) -> None:
        """Send setpoints to the drives that are enabled in this lifecycle state, and switch off all other drives.

        The order matters. Drives get the lifecycle state before anything else. Then errors of drives are reset, which
        needs the lifecycle state and the isolated joints of the cycle before. Setpoints are last.

        Args:
            setpoints: Setpoints of all joints that have passed the limiter, and which joints are isolated.
            lifecycle: Lifecycle state of the robot in this cycle.
        """
        if not self._is_open:
            return
        self._send_lifecycle_state(lifecycle, setpoints.isolated)
        reconnected_joints = self._update_isolated_joints(setpoints.isolated)
        connected_joints = frozenset(range(len(self._joint_names))) - self._isolated_joints
        self._reset_faults_if_requested(lifecycle, connected_joints, reconnected_joints)
        self._driven_joints = self._select_joints_to_drive(
            lifecycle, connected_joints, setpoints.mode
        )
        self._lifecycle = lifecycle  # only now: both calls above compare it with the new state
        command = BusCommand(
            enabled_drives=self._driven_joints,
            modes=setpoints.mode,
            targets=self._mounting.to_drive_targets(setpoints.mode, setpoints.target),
            limits_nm=self._mounting.to_drive_torque_limit_nm(np.array(setpoints.torque_limit_nm)),
            may_enable=lifecycle == "armed",
            emergency=lifecycle == "estop",
        )
        self._drives.send_setpoints(command)

    def advance(self) -> None:
        """Receive what has arrived. In lockstep, advance the robot's time by one control cycle."""
        self._require_open()
        self._clock.robot_time_ns += self._period_ns
        self._drives.poll()

    def faults(self) -> list[Fault]:
        """Return the faults that are new since the last call, and stop the robot at once if they are not isolated.

        The HAL isolates faults of single joints if the robot may continue without these joints. After any other fault
        the drives get the lifecycle state `fault` now, and not only with the setpoints of the next cycle.

        Returns:
            The new faults; empty if there are none or the backend is closed.
        """
        if not self._is_open:
            return []
        new_findings = self._reported_findings.filter_new(self._collect_relevant_findings())
        failed_joints = frozenset(
            finding.joint for finding in new_findings if finding.joint is not None
        )
        if self._can_isolate(new_findings, failed_joints):
            self._joints_awaiting_isolation |= failed_joints
        elif new_findings and self._lifecycle not in LATCHED_STATES:
            try:
                self._send_lifecycle_state("fault", self._isolated_joints)
            except (
                BackendError
            ) as error:  # report the faults all the same; the failing bus raises in the next cycle
                new_findings.append(FaultFinding("stop_not_sent", str(error)))
            # Now, so that a reset before the next control cycle is recognized, too.
            self._lifecycle = "fault"
        return [finding.to_fault(self._tick, self._joint_names) for finding in new_findings]

    def list_arming_obstacles(self) -> list[str]:
        """Return why the robot cannot be armed: the drives that have not finished their start-up."""
        obstacles: list[str] = []
        for i, reason in enumerate(self._readings.not_ready_reasons):
            if reason and i not in self._isolated_joints:
                obstacles.append(reason)
        return obstacles

    def inject(self, injection: FaultInjection, *, begins: bool) -> bool:
        """Start or end an injected fault of a bus or of a drive that is emulated here.

        Returns:
            True if the fault was started or ended; False if this backend cannot inject it.

        Raises:
            ConfigError: The fault cannot be injected into this robot.
        """
        return self._drives.inject(injection, begins=begins)

    def close(self) -> None:
        """Switch all motors off and close the buses."""
        if not self._is_open:
            return
        self._is_open = False
        try:
            self._drives.close()
        finally:
            if self._mocap is not None:
                self._mocap.close()

    # --- inside -----------------------------------------------------------------------------------------------

    def _update_isolated_joints(self, isolated: frozenset[int]) -> frozenset[int]:
        """Store which joints the HAL isolates now, and return those that are connected again.

        Connected again are the joints that were isolated before, and those that were reported as failed but not
        isolated, for example because the operator reset the robot in the same cycle.
        """
        reconnected_joints = (self._isolated_joints | self._joints_awaiting_isolation) - isolated
        self._isolated_joints = isolated
        self._joints_awaiting_isolation = NO_DRIVES
        return reconnected_joints

    def _select_joints_to_drive(
        self,
        lifecycle: LifecycleState,
        connected_joints: frozenset[int],
        modes: Sequence[JointMode],
    ) -> frozenset[int]:
        """Return the joints whose drives get setpoints in this lifecycle state, and update which joints still brake.

        In a fault these are the joints that were driven before the fault and still brake; no drive is enabled anew.

        Args:
            lifecycle: Lifecycle state of the robot in this cycle.
            connected_joints: Indices of the joints that are not isolated.
            modes: Mode of every joint's setpoint, from tail to head.

        Returns:
            Indices of the joints to drive; empty if the robot is not armed and does not brake.
        """
        if lifecycle != "fault":
            self._braking.reset()
        match lifecycle:
            case "armed":
                return connected_joints
            case "fault":
                velocity_rad_s = self._mounting.to_joint_velocity_rad_s(
                    self._readings.velocity_rad_s
                )
                driven_before = connected_joints & self._driven_joints
                return self._braking.select_braking_joints(
                    driven_before, modes, velocity_rad_s, self._clock.now_ns()
                )
            case _:
                return NO_DRIVES

    def _reset_faults_if_requested(
        self,
        lifecycle: LifecycleState,
        connected_joints: frozenset[int],
        reconnected_joints: frozenset[int],
    ) -> None:
        """Reset errors of drives if the operator has just reset the robot; otherwise do nothing.

        A reset shows in one of two ways: the robot leaves a latched state, which resets all connected drives, or
        isolated joints are connected again, which resets only these. Call it before `_lifecycle` gets the new state.

        Args:
            lifecycle: The new lifecycle state.
            connected_joints: Indices of the joints that are not isolated.
            reconnected_joints: Indices of the joints that were isolated, or were to be isolated, in the last cycle.
        """
        if lifecycle in LATCHED_STATES:
            return
        was_latched = self._lifecycle in LATCHED_STATES
        if not was_latched and not reconnected_joints:
            return
        self._reported_findings.reset()
        self._drives.reset_faults(connected_joints if was_latched else reconnected_joints)
        self._remaining_grace_cycles = self.reset_grace_cycles * self._decimation

    def _collect_relevant_findings(self) -> list[FaultFinding]:
        """Return what is wrong now, without isolated joints and without errors that may be from before a reset."""
        findings = [*self._drives.list_findings(), *self._find_silent_drives()]
        relevant: list[FaultFinding] = []
        for finding in findings:
            is_known = finding.affects_only_joint and finding.joint in self._isolated_joints
            is_outdated = self._remaining_grace_cycles > 0 and finding.joint is not None
            if not is_known and not is_outdated:
                relevant.append(finding)
        return relevant

    def _can_isolate(self, findings: list[FaultFinding], failed_joints: frozenset[int]) -> bool:
        """Return whether the robot may stay armed without the failed joints, which the HAL then isolates."""
        if self._lifecycle != "armed":
            return False
        if len(self._isolated_joints | failed_joints) > self._max_isolated_joint_count:
            return False
        return all(finding.affects_only_joint for finding in findings)

    def _require_open(self) -> None:
        if not self._is_open:
            raise BackendError("the buses are closed; open a new backend", code="backend/closed")

    def _make_description(self, config: RunConfig, name: str, hardware: str) -> RobotDescription:
        description = describe_run_robot(config, name, emulated=self._drives.emulated)
        pose_sensor = config.robot.sensors.pose
        pose_delay_s = None
        if self._mocap is not None and pose_sensor is not None:
            pose_delay_s = pose_sensor.delay_s
        sensors = self._describe_sensors(config, pose_delay_s)
        return msgspec.structs.replace(description, sensors=sensors, hardware=hardware)

    # --- hooks that a driver type may replace -----------------------------------------------------------------

    def _send_lifecycle_state(self, lifecycle: LifecycleState, isolated: frozenset[int]) -> None:
        """Send the robot's lifecycle state to drives that have such states of their own.

        Called before anything else that a control cycle sends, and at once when a fault is found.
        """

    def _make_samples(self, tick: int, timestamp_ns: int) -> Samples:
        """Return the joint state and the other sensors that are due, from what was read."""
        others: dict[str, Message] = {}
        if tick % len(self._joint_names) == 0:
            max_age_ns = (
                MAX_HEALTH_AGE_ROUNDS * len(self._joint_names) * self._decimation * self._period_ns
            )
            others[keys.POWER] = self._readings.make_power(tick, timestamp_ns, max_age_ns)
        if self._mocap is not None:
            pose = self._mocap.read_newest(tick, timestamp_ns)
            if pose is not None:
                others[keys.POSE] = pose
        return Samples(self._readings.make_joint_state(tick, timestamp_ns, self._lease_ns), others)

    def _find_silent_drives(self) -> list[FaultFinding]:
        """Return a finding for each drive that has left several requests unanswered."""
        findings: list[FaultFinding] = []
        for i, name in enumerate(self._joint_names):
            if self._readings.count_unanswered_requests(i) >= MIN_UNANSWERED_REQUESTS:
                silent_ms = self._readings.compute_age_ns(i) * 1e-6
                cause = f"{name}: its drive has not answered for {silent_ms:.0f} ms: power, cable, id or a restart"
                findings.append(FaultFinding("drive_silent", cause, i, affects_only_joint=True))
        return findings

    def _describe_sensors(
        self, config: RunConfig, pose_delay_s: float | None
    ) -> list[SensorDescription]:
        """Return the sensors with their rates and delays.

        Args:
            config: Configuration of the run, with the robot and the settings of its backend.
            pose_delay_s: Delay of motion capture; None without it.
        """
        rate_hz = config.rate_hz
        delay_s = (self._decimation - 1) / rate_hz
        sensors = [
            SensorDescription(key=keys.JOINTS, rate_hz=rate_hz, delay_s=delay_s),
            SensorDescription(
                key=keys.POWER, rate_hz=rate_hz / len(self._joint_names), delay_s=0.0
            ),
        ]
        if pose_delay_s is not None:
            sensors.append(SensorDescription(key=keys.POSE, rate_hz=rate_hz, delay_s=pose_delay_s))
        return sensors


def _mark_missing_watchdogs(robot: RobotDescription, joints: frozenset[int]) -> RobotDescription:
    """Return a description in which these joints have no watchdog."""
    noted = [
        msgspec.structs.replace(joint, watchdog=False) if i in joints else joint
        for i, joint in enumerate(robot.joints)
    ]
    return msgspec.structs.replace(robot, joints=noted)
