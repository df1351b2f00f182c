"""What the drives of a robot measured, at their shafts, and when: joint states with ages, supply and temperatures.

A joint whose drive is silent keeps its last values, and their age grows; no value is invented. Silence is counted in
requests without an answer rather than in time, because a computer that pauses also sends its requests late. If a value
is not finite, the call that stores it is ignored, as if the drive had not sent any of its values.
"""

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from snakesim_drivers.mounting import DriveMounting
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.wire.messages import JointState, Power

NEVER = -1  # the time of a value that no drive has sent yet
UNKNOWN_AGE_NS = 3600 * 10**9  # of a value that no drive has sent yet: older than any lease
MAX_AWAITED_REQUESTS = 2  # a drive that left more requests unanswered is not waited for


class DriveReadings:
    """The newest values of every drive, from tail to head. All methods take the index of a drive as `i`."""

    def __init__(self, joints: Sequence[Joint], clock_ns: Callable[[], int]) -> None:
        """Allocate the readings of some drives, none of which has reported a value yet.

        Args:
            joints: The joints of these drives, from tail to head.
            clock_ns: Function that returns the driver's time in ns, to timestamp values.
        """
        count = len(joints)
        self.mounting = DriveMounting(joints)
        self._clock_ns = clock_ns
        self._measures_torque = ["torque" in joint.drive.measures for joint in joints]
        # Motion and torque.
        self.angle_rad: Floats = np.zeros(count)
        self.velocity_rad_s: Floats = np.zeros(count)
        self.torque_nm: Floats = np.zeros(count)
        self._motion_read_ns = [NEVER] * count
        self._torque_read_ns = [NEVER] * count
        # Supply and temperatures.
        self._voltage_v = [0.0] * count
        self._current_a = [0.0] * count
        self._motor_temperature_c = [0.0] * count
        self._board_temperature_c = [0.0] * count
        self._health_read_ns = [NEVER] * count
        # Identity; empty: the drive does not report it.
        self.serials = [""] * count
        self.firmware = [""] * count
        # Why a drive is not ready to be armed, for the operator; empty: it is.
        self.not_ready_reasons = [""] * count
        # Requests are numbered. Every drive starts as one that has not answered for long.
        self._request_number = MAX_AWAITED_REQUESTS  # number of the newest request
        # Number of the newest request that was answered with motion.
        self._motion_request_number = [0] * count
        # Number of the newest request that was answered with torque.
        self._torque_request_number = [0] * count
        # Drives that may have switched themselves off.
        self._drives_to_check: set[int] = set()

    # --- called by the driver when it sends and receives ------------------------------------------------------

    def set_identity(self, i: int, *, serial: str = "", firmware: str = "") -> None:
        """Store the serial number and the firmware version of a drive. Empty values change nothing.

        Args:
            i: Index of the drive.
            serial: Serial number, as the drive reports it.
            firmware: Version of the drive's firmware.
        """
        self.serials[i] = serial or self.serials[i]
        self.firmware[i] = firmware or self.firmware[i]

    def set_not_ready(self, i: int, reason: str) -> None:
        """Store why the robot cannot be armed because of a drive.

        Args:
            i: Index of the drive.
            reason: Text for the operator, with the name of the drive; empty if the drive is ready.
        """
        self.not_ready_reasons[i] = reason

    def start_request(self) -> None:
        """Note that all drives are requested to send motion and torque. The kit calls this before `Drives.read`."""
        self._request_number += 1

    def skip_request(self, i: int) -> None:
        """Note that the newest request did not reach this drive, so that its silence means nothing."""
        self._motion_request_number[i] += 1
        self._torque_request_number[i] += 1

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
        self._motion_read_ns[i] = self._clock_ns()
        self._motion_request_number[i] = self._request_number

    def set_torque(self, i: int, torque_nm: float) -> None:
        """Store the torque at a drive's shaft.

        Args:
            i: Index of the drive.
            torque_nm: Torque of the motor at the shaft.
        """
        if not math.isfinite(torque_nm):
            return
        self.torque_nm[i] = torque_nm
        self._torque_read_ns[i] = self._clock_ns()
        self._torque_request_number[i] = self._request_number

    def set_supply(self, i: int, voltage_v: float, current_a: float) -> None:
        """Store the supply of a drive.

        Args:
            i: Index of the drive.
            voltage_v: Voltage at the drive.
            current_a: Current that the drive draws; 0 if it does not measure it.
        """
        if math.isfinite(voltage_v) and math.isfinite(current_a):
            self._voltage_v[i] = voltage_v
            self._current_a[i] = current_a

    def set_temperatures(self, i: int, motor_c: float, board_c: float) -> None:
        """Store the temperatures of a drive. They complete its health, so drivers call `set_supply` first.

        Args:
            i: Index of the drive.
            motor_c: Temperature of the motor in °C.
            board_c: Temperature of the electronics in °C; that of the motor again if the drive has only one sensor.
        """
        if math.isfinite(motor_c) and math.isfinite(board_c):
            self._motor_temperature_c[i] = motor_c
            self._board_temperature_c[i] = board_c
            self._health_read_ns[i] = self._clock_ns()

    def copy_from(self, source: "DriveReadings", destination_indices: Sequence[int]) -> None:
        """Copy the readings of some drives from another object, with the times at which they were read.

        Args:
            source: Readings of the drives of one bus.
            destination_indices: Index in this object for each drive of `source`.
        """
        # Both objects number their requests by themselves. The number of unanswered requests must stay the same.
        request_number_offset = self._request_number - source._request_number
        for i, destination in enumerate(destination_indices):
            self.angle_rad[destination] = source.angle_rad[i]
            self.velocity_rad_s[destination] = source.velocity_rad_s[i]
            self.torque_nm[destination] = source.torque_nm[i]
            self._motion_read_ns[destination] = source._motion_read_ns[i]
            self._torque_read_ns[destination] = source._torque_read_ns[i]
            self._motion_request_number[destination] = (
                request_number_offset + source._motion_request_number[i]
            )
            self._torque_request_number[destination] = (
                request_number_offset + source._torque_request_number[i]
            )
            self._voltage_v[destination] = source._voltage_v[i]
            self._current_a[destination] = source._current_a[i]
            self._motor_temperature_c[destination] = source._motor_temperature_c[i]
            self._board_temperature_c[destination] = source._board_temperature_c[i]
            self._health_read_ns[destination] = source._health_read_ns[i]
            self.serials[destination] = source.serials[i]
            self.firmware[destination] = source.firmware[i]
            self.not_ready_reasons[destination] = source.not_ready_reasons[i]

    # --- drives that may have switched themselves off ---------------------------------------------------------

    @property
    def drives_to_check(self) -> frozenset[int]:
        """The drives that may have switched themselves off since they were read last.

        A driver requests their state with the next reading. Until it has the answer, it must not send them anything
        that clears a latched stop.
        """
        return frozenset(self._drives_to_check)

    def require_check(self, drives: Iterable[int]) -> None:
        """Note that the driver or these drives were silent for so long that their watchdogs may have expired."""
        self._drives_to_check.update(drives)

    def mark_checked(self, i: int) -> None:
        """Note that a drive has just reported whether it is on, and whether it has stopped by itself."""
        self._drives_to_check.discard(i)

    # --- what is known ----------------------------------------------------------------------------------------

    def has_reported(self, i: int) -> bool:
        """Return whether a drive has ever sent everything that it measures."""
        if self._motion_read_ns[i] == NEVER:
            return False
        return self._torque_read_ns[i] != NEVER or not self._measures_torque[i]

    def count_unanswered_requests(self, i: int) -> int:
        """Return how many requests in a row a drive has not answered completely."""
        last_answered_request = self._motion_request_number[i]
        if self._measures_torque[i]:
            last_answered_request = min(last_answered_request, self._torque_request_number[i])
        return self._request_number - last_answered_request

    def is_awaiting_responses(self) -> bool:
        """Return whether responses are missing from drives that responded lately, so that waiting is useful."""
        drive_count = len(self._measures_torque)
        return any(
            0 < self.count_unanswered_requests(i) <= MAX_AWAITED_REQUESTS
            for i in range(drive_count)
        )

    def compute_age_ns(self, i: int) -> int:
        """Return the age of the older one of a drive's motion and torque, in ns.

        `UNKNOWN_AGE_NS` is returned for a drive that has not reported both yet.
        """
        if not self.has_reported(i):
            return UNKNOWN_AGE_NS
        read_ns = self._motion_read_ns[i]
        if self._measures_torque[i]:
            read_ns = min(read_ns, self._torque_read_ns[i])
        return max(self._clock_ns() - read_ns, 0)

    def make_joint_state(self, tick: int, timestamp_ns: int, lease_ns: int) -> JointState:
        """Return a `JointState` message with the newest values, converted to the joints.

        Values older than the lease are marked as invalid. An unmeasured torque is 0.

        Args:
            tick: Number of the control cycle.
            timestamp_ns: Current time of the robot.
            lease_ns: Maximum age of valid values.
        """
        ages_ns = [self.compute_age_ns(i) for i in range(len(self._measures_torque))]
        return JointState(
            tick=tick,
            timestamp_ns=timestamp_ns,
            angle_rad=self.mounting.to_joint_angle_rad(self.angle_rad).tolist(),
            velocity_rad_s=self.mounting.to_joint_velocity_rad_s(self.velocity_rad_s).tolist(),
            torque_nm=self.mounting.to_joint_torque_nm(self.torque_nm).tolist(),
            valid=[age_ns <= lease_ns for age_ns in ages_ns],
            age_ns=ages_ns,
        )

    def make_power(self, tick: int, timestamp_ns: int, max_age_ns: int) -> Power:
        """Return a `Power` message with the newest supply values and temperatures of all drives.

        Values older than `max_age_ns` are marked as invalid. These drives have no leak sensors.

        Args:
            tick: Number of the control cycle.
            timestamp_ns: Current time of the robot.
            max_age_ns: Maximum age of valid values.
        """
        now_ns = self._clock_ns()
        valid = [
            read_ns != NEVER and now_ns - read_ns <= max_age_ns for read_ns in self._health_read_ns
        ]
        return Power(
            tick=tick,
            timestamp_ns=timestamp_ns,
            voltage_v=list(self._voltage_v),
            current_a=list(self._current_a),
            motor_c=list(self._motor_temperature_c),
            board_c=list(self._board_temperature_c),
            leak=[False] * len(self._health_read_ns),
            valid=valid,
        )
