"""What the drives of a robot measured, at their shafts, and when: joint states with ages, supply and temperatures.

A joint whose drive is silent keeps its last values, and their age grows; no value is invented. Silence is counted in
requests without an answer rather than in time, because a computer that pauses also sends its requests late. A value
that is not finite is ignored, as if the drive had not sent it.
"""

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from snakesim_drivers.mounting import Mounting
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.joints import Joint
from snakesim_hal.wire.messages import JointState, Power

NEVER = -1  # the time of a value that no drive has sent yet
UNKNOWN_AGE_NS = 3600 * 10**9  # of a value that no drive has sent yet: older than any lease
MAX_AWAITED_REQUESTS = 2  # a drive that left more requests unanswered is not waited for


class DriveReadings:
    """The newest values of every drive, from tail to head. All methods take the index of a drive as `i`."""

    def __init__(self, joints: Sequence[Joint], clock_ns: Callable[[], int]) -> None:
        """Allocate the readings of some drives, none of which has reported a value yet.

        Args:
            joints: The joints of these drives, tail to head.
            clock_ns: Returns the time at which a value is read.
        """
        count = len(joints)
        self.mounting = Mounting(joints)
        self._clock_ns = clock_ns
        self._measures_torque = ["torque" in joint.drive.measures for joint in joints]
        # Motion and torque.
        self.angle_rad: Floats = np.zeros(count)
        self.velocity_rad_s: Floats = np.zeros(count)
        self.torque_nm: Floats = np.zeros(count)
        self._motion_ns = [NEVER] * count
        self._torque_ns = [NEVER] * count
        # Supply and temperatures.
        self._voltage_v = [0.0] * count
        self._current_a = [0.0] * count
        self._motor_c = [0.0] * count
        self._board_c = [0.0] * count
        self._health_ns = [NEVER] * count
        # Identity; empty: the drive does not report it.
        self.serials = [""] * count
        self.firmware = [""] * count
        # Why a drive is not ready to be armed, for the operator; empty: it is.
        self.not_ready = [""] * count
        # Requests, by their number.
        self._request = MAX_AWAITED_REQUESTS  # the newest one
        self._motion_request = [0] * count  # the newest one that was answered
        self._torque_request = [0] * count
        # Drives that may have switched themselves off.
        self._to_check: set[int] = set()

    # --- called by the driver when it sends and receives ------------------------------------------------------

    def set_identity(self, i: int, *, serial: str = "", firmware: str = "") -> None:
        """Store the serial number and the firmware version of a drive; empty values change nothing.

        Args:
            i: Index of the drive.
            serial: Serial number, as the drive reports it.
            firmware: Version of its firmware.
        """
        self.serials[i] = serial or self.serials[i]
        self.firmware[i] = firmware or self.firmware[i]

    def set_not_ready(self, i: int, reason: str) -> None:
        """Store why the robot cannot be armed because of a drive.

        Args:
            i: Index of the drive.
            reason: For the operator, with the name of the drive; empty if it is ready.
        """
        self.not_ready[i] = reason

    def count_request(self) -> None:
        """Note that all drives are requested to send motion and torque."""
        self._request += 1

    def skip_request(self, i: int) -> None:
        """Note that the newest request did not reach this drive, so that its silence means nothing."""
        self._motion_request[i] += 1
        self._torque_request[i] += 1

    def set_motion(self, i: int, angle_rad: float, velocity_rad_s: float) -> None:
        """Store the angle and the velocity of a drive's shaft.

        Args:
            i: Index of the drive.
            angle_rad: Angle of the shaft.
            velocity_rad_s: Velocity of the shaft.
        """
        if not (math.isfinite(angle_rad) and math.isfinite(velocity_rad_s)):
            return
        self.angle_rad[i] = angle_rad
        self.velocity_rad_s[i] = velocity_rad_s
        self._motion_ns[i] = self._clock_ns()
        self._motion_request[i] = self._request

    def set_torque(self, i: int, torque_nm: float) -> None:
        """Store the torque at a drive's shaft.

        Args:
            i: Index of the drive.
            torque_nm: Torque of the motor at the shaft.
        """
        if not math.isfinite(torque_nm):
            return
        self.torque_nm[i] = torque_nm
        self._torque_ns[i] = self._clock_ns()
        self._torque_request[i] = self._request

    def set_supply(self, i: int, voltage_v: float, current_a: float) -> None:
        """Store the supply of a drive.

        Args:
            i: Index of the drive.
            voltage_v: Voltage at the drive.
            current_a: Current that the drive draws.
        """
        if math.isfinite(voltage_v) and math.isfinite(current_a):
            self._voltage_v[i] = voltage_v
            self._current_a[i] = current_a

    def set_temperatures(self, i: int, motor_c: float, board_c: float) -> None:
        """Store the temperatures of a drive. They complete its health, so drivers call `set_supply` before.

        Args:
            i: Index of the drive.
            motor_c: Temperature of the motor in °C.
            board_c: Temperature of the electronics in °C.
        """
        if math.isfinite(motor_c) and math.isfinite(board_c):
            self._motor_c[i] = motor_c
            self._board_c[i] = board_c
            self._health_ns[i] = self._clock_ns()

    def copy_from(self, source: "DriveReadings", indices: Sequence[int]) -> None:
        """Copy all values of another object, with the times at which they were read.

        Args:
            source: Readings of some of these drives.
            indices: For each drive of `source`, its index here.
        """
        request_offset = self._request - source._request
        for i, j in enumerate(indices):
            self.angle_rad[j] = source.angle_rad[i]
            self.velocity_rad_s[j] = source.velocity_rad_s[i]
            self.torque_nm[j] = source.torque_nm[i]
            self._motion_ns[j] = source._motion_ns[i]
            self._torque_ns[j] = source._torque_ns[i]
            self._motion_request[j] = request_offset + source._motion_request[i]
            self._torque_request[j] = request_offset + source._torque_request[i]
            self._voltage_v[j] = source._voltage_v[i]
            self._current_a[j] = source._current_a[i]
            self._motor_c[j] = source._motor_c[i]
            self._board_c[j] = source._board_c[i]
            self._health_ns[j] = source._health_ns[i]
            self.serials[j] = source.serials[i]
            self.firmware[j] = source.firmware[i]
            self.not_ready[j] = source.not_ready[i]

    # --- drives that may have switched themselves off ---------------------------------------------------------

    @property
    def drives_to_check(self) -> frozenset[int]:
        """The drives that may have switched themselves off since they were read last.

        A driver requests their state with the next reading. Until it has the answer, it must not send them anything
        that clears a latched stop.
        """
        return frozenset(self._to_check)

    def require_check(self, drives: Iterable[int]) -> None:
        """Note that the driver or these drives were silent for so long that their watchdogs may have expired."""
        self._to_check.update(drives)

    def mark_checked(self, i: int) -> None:
        """Note that a drive has just reported whether it is on, and whether it has stopped by itself."""
        self._to_check.discard(i)

    # --- what is known ----------------------------------------------------------------------------------------

    def is_known(self, i: int) -> bool:
        """Return whether a drive has ever sent everything that it measures."""
        if self._motion_ns[i] == NEVER:
            return False
        return self._torque_ns[i] != NEVER or not self._measures_torque[i]

    def unanswered_requests(self, i: int) -> int:
        """Return how many requests in a row a drive has not answered completely."""
        answered = self._motion_request[i]
        if self._measures_torque[i]:
            answered = min(answered, self._torque_request[i])
        return self._request - answered

    def is_incomplete(self) -> bool:
        """Return whether answers are missing from drives that answered lately: these are worth waiting for."""
        drive_count = len(self._measures_torque)
        return any(0 < self.unanswered_requests(i) <= MAX_AWAITED_REQUESTS for i in range(drive_count))

    def age_ns(self, i: int) -> int:
        """Return the age of a drive's motion and torque, of the older one."""
        if not self.is_known(i):
            return UNKNOWN_AGE_NS
        read_ns = self._motion_ns[i]
        if self._measures_torque[i]:
            read_ns = min(read_ns, self._torque_ns[i])
        return max(self._clock_ns() - read_ns, 0)

    def joint_state(self, tick: int, timestamp_ns: int, lease_ns: int) -> JointState:
        """Return the joint state as a message. Values older than the lease are invalid, and an unmeasured torque is 0.

        Args:
            tick: Number of the control cycle.
            timestamp_ns: The robot's time.
            lease_ns: The age from which values are invalid.
        """
        ages_ns = [self.age_ns(i) for i in range(len(self._measures_torque))]
        return JointState(
            tick=tick,
            timestamp_ns=timestamp_ns,
            angle_rad=self.mounting.to_joint_angle_rad(self.angle_rad).tolist(),
            velocity_rad_s=self.mounting.to_joint_velocity_rad_s(self.velocity_rad_s).tolist(),
            torque_nm=self.mounting.to_joint_torque_nm(self.torque_nm).tolist(),
            valid=[age_ns <= lease_ns for age_ns in ages_ns],
            age_ns=ages_ns,
        )

    def power(self, tick: int, timestamp_ns: int, max_age_ns: int) -> Power:
        """Return supply and temperatures; values older than `max_age_ns` are invalid.

        Args:
            tick: Number of the control cycle.
            timestamp_ns: The robot's time.
            max_age_ns: The age from which values are invalid.
        """
        now_ns = self._clock_ns()
        valid = [read_ns != NEVER and now_ns - read_ns <= max_age_ns for read_ns in self._health_ns]
        return Power(
            tick=tick,
            timestamp_ns=timestamp_ns,
            voltage_v=list(self._voltage_v),
            current_a=list(self._current_a),
            motor_c=list(self._motor_c),
            board_c=list(self._board_c),
            leak=[False] * len(self._health_ns),
            valid=valid,
        )
