"""A whole backend over a driver type of drives. The driver type speaks the protocol, in `Drives`; all else is here.

A tick: every drive is asked what it measures, and answers; it then gets its setpoint, which holds until the next. All
numbers between here and a driver type are those of the drives' shafts, in SI units.
"""

import time
from collections.abc import Callable, Sequence
from typing import Protocol

import msgspec
import numpy as np

from snakesim_drivers.kit.braking import Braking
from snakesim_drivers.kit.findings import Finding, ReportedFindings
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_drivers.motion_capture.mocap import MocapReceiver
from snakesim_hal.backend import Samples, Setpoints
from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.fault_kinds import Injection
from snakesim_hal.model.robot import identified
from snakesim_hal.model.scenario import RunConfig, description_of
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Description, Fault, LifecycleState, Message, Mode, SensorDescription

LATCHED = ("fault", "estop")
SILENT_AFTER = 3  # questions without an answer
CLEAR_GRACE = 5  # periods in which errors of drives may be of before a clear
HEALTH_ROUNDS = 3  # in which a drive may not say its health before that is unknown


class Drives(Protocol):
    """The drives of one driver type on their buses, tail to head. Every method returns within a period."""

    emulated: bool  # nothing real moves

    def bring_up(self) -> None:
        """Find every drive, check it, write its settings; nothing is enabled. May take long. Raises BackendError."""
        ...

    def read(self) -> None:
        """Ask every drive, and put what it says into the readings; does not wait for silent ones."""
        ...

    def command(
        self,
        following: frozenset[int],
        modes: list[Mode],
        targets: Floats,
        limits_nm: Floats,
        *,
        may_enable: bool,
        emergency: bool,
    ) -> None:
        """Setpoints of the drives that follow; any other is to be idle, and is told again if it is not.

        A drive that begins to follow is enabled after it has its setpoint. may_enable: the robot is armed; otherwise
        a drive that is not on stays off. emergency: by the drives' own stop.
        """
        ...

    def reset_faults(self, joints: frozenset[int]) -> None:
        """The fault was cleared: clear errors of these drives, and write settings that a restart may have lost."""
        ...

    def findings(self) -> list[Finding]:
        """What is wrong now with drives and buses; a silent drive need not be among it."""
        ...

    def poll(self) -> None:
        """Receive; drives that are emulated in this process run, up to the present time."""
        ...

    def inject(self, injection: Injection, *, begins: bool) -> bool:
        """Begin or end a fault of a bus or of drives emulated here; False for any other."""
        ...

    def close(self) -> None:
        """Motors off, buses closed; safe in every state."""
        ...


class DriverClock:
    """The time of a driver: a steady clock, or in lockstep the robot's own time, which `sample` sets."""

    def __init__(self, config: RunConfig) -> None:
        self._lockstep, self.robot_ns = config.clock_mode == "lockstep", 0

    def now_ns(self) -> int:
        """Now."""
        return self.robot_ns if self._lockstep else time.monotonic_ns()


class DriveBackend:
    """A `snakesim_hal.backend.Backend`. What a driver type with more than `Drives` may add is at the end."""

    clear_grace = CLEAR_GRACE

    def __init__(
        self,
        config: RunConfig,
        name: str,
        hardware: str,
        clock: DriverClock,
        mocap: MocapReceiver | None,
        make_drives: Callable[[DriveReadings], Drives],
        watchdogs_s: Sequence[float],
        decimation: int = 1,
    ) -> None:
        """make_drives: opens the buses; watchdogs_s: of every joint's drive; decimation: of the slowest bus.

        Raises ConfigError and BackendError.
        """
        joints = config.robot.joint_table
        self._clock, self._mocap, self._open = clock, mocap, True
        self._period_ns, self._lease_ns, self._every = config.period_ns, config.lease_ns, decimation
        self._names = [joint.name for joint in joints]
        self._readings = DriveReadings(joints, clock.now_ns)
        self._mounting = self._readings.mounting
        self._max_isolated = config.robot.safety.max_isolated_joints
        self._told = ReportedFindings()
        self._braking = Braking(
            [round(watchdog_s * 1e9) for watchdog_s in watchdogs_s], holds=config.robot.safety.action == "hold"
        )
        self._lifecycle: LifecycleState = "disarmed"
        self._following: frozenset[int] = frozenset()
        self._isolated: frozenset[int] = frozenset()
        self._pending: frozenset[int] = frozenset()  # just reported as failed: their isolation is expected
        self._tick, self._quiet = 0, 0
        try:
            self._drives = make_drives(self._readings)
        except BaseException:
            if mocap is not None:
                mocap.close()
            raise
        try:
            self._drives.bring_up()
        except BaseException:
            self.close()
            raise
        described = self._describe(config, name, hardware)
        self._description = identified(described, self._readings.serials, self._readings.firmware)

    def describe(self) -> Description:
        """The robot of the robot file, with the sensors that its drives are."""
        return self._description

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """Ask all drives."""
        self._must_be_open()
        self._tick, self._clock.robot_ns, self._quiet = tick, timestamp_ns, self._quiet - 1
        self._readings.count_request()
        self._drives.read()
        return self._make_samples(tick, timestamp_ns)

    def enact(self, setpoints: Setpoints, lifecycle: LifecycleState) -> None:
        """Armed: all that are not isolated follow. At fault those go on that did, while they brake."""
        if not self._open:
            return
        self._send_lifecycle(lifecycle, setpoints.isolated)
        back = (self._isolated | self._pending) - setpoints.isolated
        self._isolated, self._pending = setpoints.isolated, frozenset()
        everybody = frozenset(range(len(self._names))) - self._isolated
        if lifecycle not in LATCHED and (back or self._lifecycle in LATCHED):
            self._told.reset()
            self._drives.reset_faults(everybody if self._lifecycle in LATCHED else back)
            self._quiet = self.clear_grace * self._every
        self._following = self._joints_to_drive(lifecycle, everybody, setpoints.mode)
        self._lifecycle = lifecycle
        self._drives.command(
            self._following,
            setpoints.mode,
            self._mounting.drive_targets(setpoints.mode, setpoints.target),
            self._mounting.drive_torque_limit_nm(np.array(setpoints.torque_limit_nm)),
            may_enable=lifecycle == "armed",
            emergency=lifecycle == "estop",
        )

    def advance(self) -> None:
        """Time passes by itself; in lockstep, by a period."""
        self._must_be_open()
        self._clock.robot_ns += self._period_ns
        self._drives.poll()

    def faults(self) -> list[Fault]:
        """New ones since the last call."""
        if not self._open:
            return []
        found = [*self._drives.findings(), *self._find_silent_drives()]
        found = [finding for finding in found if not (finding.alone and finding.joint in self._isolated)]
        if self._quiet > 0:
            found = [finding for finding in found if finding.joint is None]
        fresh = self._told.filter_new(found)
        failed = frozenset(finding.joint for finding in fresh if finding.joint is not None)
        few = len(self._isolated | failed) <= self._max_isolated
        if self._lifecycle == "armed" and few and all(finding.alone for finding in fresh):
            self._pending |= failed  # the HAL isolates them
        elif fresh and self._lifecycle not in LATCHED:
            try:
                self._send_lifecycle("fault", self._isolated)
            except BackendError as error:  # the faults are reported all the same; the failing bus raises again
                fresh.append(Finding("stop_not_sent", str(error)))
            self._lifecycle = "fault"  # from now on only a clear ends it, also one before the next period
        return [finding.to_fault(self._tick, self._names) for finding in fresh]

    def inject(self, injection: Injection, *, begins: bool) -> bool:
        """Injects faults of buses and of drives emulated here. Raises ConfigError."""
        return self._drives.inject(injection, begins=begins)

    def close(self) -> None:
        """Motors off, buses closed."""
        if not self._open:
            return
        self._open = False
        self._drives.close()
        if self._mocap is not None:
            self._mocap.close()

    # --- inside -----------------------------------------------------------------------------------------------

    def _joints_to_drive(
        self, lifecycle: LifecycleState, connected: frozenset[int], modes: Sequence[Mode]
    ) -> frozenset[int]:
        """Return the joints whose drives get setpoints in this lifecycle state. A fault begins with no new one."""
        if lifecycle != "fault":
            self._braking.reset()
        match lifecycle:
            case "armed":
                return connected
            case "fault":
                speeds = self._mounting.joint_velocity_rad_s(self._readings.velocity_rad_s)
                return self._braking.select_braking_joints(
                    connected & self._following, modes, speeds, self._clock.now_ns()
                )
            case _:
                return frozenset()

    def _must_be_open(self) -> None:
        if not self._open:
            raise BackendError("the buses are closed; open a new backend")

    def _describe(self, config: RunConfig, name: str, hardware: str) -> Description:
        plain = description_of(config, name, emulated=self._drives.emulated)
        camera = config.robot.sensors.pose
        delay_s = camera.delay_s if self._mocap is not None and camera is not None else None
        return msgspec.structs.replace(plain, sensors=self._describe_sensors(config, delay_s), hardware=hardware)

    # --- what a driver type may replace ------------------------------------------------------------------------------

    def _send_lifecycle(self, lifecycle: LifecycleState, isolated: frozenset[int]) -> None:
        """Before anything else of a tick, and at once for a fault: for drives that know the robot's lifecycle."""

    def _make_samples(self, tick: int, timestamp_ns: int) -> Samples:
        """Joints and other sensors, from what was read."""
        others: dict[str, Message] = {}
        if tick % len(self._names) == 0:
            lasts_ns = HEALTH_ROUNDS * len(self._names) * self._every * self._period_ns
            others[keys.POWER] = self._readings.power(tick, timestamp_ns, lasts_ns)
        if self._mocap is not None and (pose := self._mocap.read_newest(tick, timestamp_ns)) is not None:
            others[keys.POSE] = pose
        return Samples(self._readings.joint_state(tick, timestamp_ns, self._lease_ns), others)

    def _find_silent_drives(self) -> list[Finding]:
        """Drives that do not answer."""
        found: list[Finding] = []
        for i, name in enumerate(self._names):
            if self._readings.unanswered_requests(i) >= SILENT_AFTER:
                silent_ms = self._readings.age_ns(i) * 1e-6
                cause = f"{name}: its drive has not answered for {silent_ms:.0f} ms: power, cable, id or a restart"
                found.append(Finding("drive_silent", cause, i, alone=True))
        return found

    def _describe_sensors(self, config: RunConfig, pose_delay_s: float | None) -> list[SensorDescription]:
        """The sensors; pose_delay_s: of motion capture, None without it."""
        rate_hz = config.rate_hz
        delay_s = (self._every - 1) / rate_hz
        sensors = [SensorDescription(key=keys.JOINTS, rate_hz=rate_hz, delay_s=delay_s)]
        sensors.append(SensorDescription(key=keys.POWER, rate_hz=rate_hz / len(self._names), delay_s=0.0))
        if pose_delay_s is not None:
            sensors.append(SensorDescription(key=keys.POSE, rate_hz=rate_hz, delay_s=pose_delay_s))
        return sensors
