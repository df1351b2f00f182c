"""What the drives of a robot said, at their shafts, and when: joint states with ages, supply and heat.

A joint whose drive is silent keeps its last values, and their age grows; nothing is invented. Silence is counted in
questions without an answer, as a computer that stutters asks late, too. What is not finite was not said.
"""

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from snakesim_drivers.mounting import Mounting
from snakesim_hal.model.joints import Joint
from snakesim_hal.wire.messages import JointState, Power

NEVER = -1
LONG_AGO_NS = 3600 * 10**9
LATELY = 2  # questions: a drive that has not answered for longer is not waited for


class DriveReadings:
    """The newest values of every drive, tail to head. `clock_ns` is the time at which a value was read."""

    def __init__(self, joints: Sequence[Joint], clock_ns: Callable[[], int]) -> None:
        count = len(joints)
        self.mounting, self._clock_ns = Mounting(joints), clock_ns
        self._feels = ["torque" in joint.drive.measures for joint in joints]
        self.angle_rad, self.velocity_rad_s, self.torque_nm = np.zeros(count), np.zeros(count), np.zeros(count)
        self._motion_ns, self._torque_ns, self._health_ns = ([NEVER] * count for _ in range(3))
        self._voltage_v, self._current_a, self._motor_c, self._board_c = ([0.0] * count for _ in range(4))
        self.serials, self.firmware = [""] * count, [""] * count  # empty: the drive does not say it
        self._asked = LATELY  # questions so far
        self._motion_at, self._torque_at = [0] * count, [0] * count  # the newest one that was answered
        self._doubted: set[int] = set()

    # --- what drives say -------------------------------------------------------------------------------------

    def set_identity(self, i: int, *, serial: str = "", firmware: str = "") -> None:
        """In bring-up a drive has said who it is, as far as it does."""
        self.serials[i], self.firmware[i] = serial or self.serials[i], firmware or self.firmware[i]

    def count_request(self) -> None:
        """All drives are being asked for motion and torque."""
        self._asked += 1

    def skip_request(self, i: int) -> None:
        """But this one could not be: its silence means nothing."""
        self._motion_at[i] += 1
        self._torque_at[i] += 1

    def set_motion(self, i: int, angle_rad: float, velocity_rad_s: float) -> None:
        """A drive has said where its shaft is."""
        if not (math.isfinite(angle_rad) and math.isfinite(velocity_rad_s)):
            return
        self.angle_rad[i], self.velocity_rad_s[i], self._motion_ns[i] = angle_rad, velocity_rad_s, self._clock_ns()
        self._motion_at[i] = self._asked

    def set_torque(self, i: int, torque_nm: float) -> None:
        """A drive has said its torque, at the shaft."""
        if math.isfinite(torque_nm):
            self.torque_nm[i], self._torque_ns[i], self._torque_at[i] = torque_nm, self._clock_ns(), self._asked

    def set_supply(self, i: int, voltage_v: float, current_a: float) -> None:
        """A drive has said its supply."""
        if math.isfinite(voltage_v) and math.isfinite(current_a):
            self._voltage_v[i], self._current_a[i] = voltage_v, current_a

    def set_temperatures(self, i: int, motor_c: float, board_c: float) -> None:
        """A drive has said its temperatures; with its supply they are its health."""
        if math.isfinite(motor_c) and math.isfinite(board_c):
            self._motor_c[i], self._board_c[i], self._health_ns[i] = motor_c, board_c, self._clock_ns()

    def copy_from(self, part: "DriveReadings", at: Sequence[int]) -> None:
        """All that some of the drives have said to another one, as of when they said it. at: their numbers here."""
        for i, j in enumerate(at):
            self.angle_rad[j], self.velocity_rad_s[j] = part.angle_rad[i], part.velocity_rad_s[i]
            self.torque_nm[j] = part.torque_nm[i]
            self._motion_ns[j], self._torque_ns[j] = part._motion_ns[i], part._torque_ns[i]
            self._motion_at[j] = self._asked - part._asked + part._motion_at[i]
            self._torque_at[j] = self._asked - part._asked + part._torque_at[i]
            self._voltage_v[j], self._current_a[j] = part._voltage_v[i], part._current_a[i]
            self._motor_c[j], self._board_c[j] = part._motor_c[i], part._board_c[i]
            self._health_ns[j] = part._health_ns[i]
            self.serials[j], self.firmware[j] = part.serials[i], part.firmware[i]

    # --- whether drives have switched themselves off ----------------------------------------------------------

    @property
    def drives_to_check(self) -> frozenset[int]:
        """Drives that may have switched themselves off since they were read last: a driver reads their state first.

        Until it has, nothing that clears a latched stop may be sent to them.
        """
        return frozenset(self._doubted)

    def require_check(self, drives: Iterable[int]) -> None:
        """The driver was silent, or these drives were, for so long that their watchdogs may have expired."""
        self._doubted.update(drives)

    def mark_checked(self, i: int) -> None:
        """A drive has just reported whether it is on, and whether it has stopped by itself."""
        self._doubted.discard(i)

    # --- what is known ---------------------------------------------------------------------------------------

    def is_known(self, i: int) -> bool:
        """Whether a drive has ever said all that it measures."""
        return self._motion_ns[i] != NEVER and (self._torque_ns[i] != NEVER or not self._feels[i])

    def unanswered_requests(self, i: int) -> int:
        """How many questions in a row a drive has not answered in full."""
        return self._asked - (min(self._motion_at[i], self._torque_at[i]) if self._feels[i] else self._motion_at[i])

    def is_incomplete(self) -> bool:
        """Whether answers are missing of drives that answered lately: those are worth waiting for."""
        return any(0 < self.unanswered_requests(i) <= LATELY for i in range(len(self._feels)))

    def age_ns(self, i: int) -> int:
        """Of the older one of motion and torque."""
        if not self.is_known(i):
            return LONG_AGO_NS
        heard_ns = min(self._motion_ns[i], self._torque_ns[i]) if self._feels[i] else self._motion_ns[i]
        return max(self._clock_ns() - heard_ns, 0)

    def joint_state(self, tick: int, timestamp_ns: int, lease_ns: int) -> JointState:
        """The joint state; a value older than the lease is invalid, and a torque that is not measured is 0."""
        ages, mounting = [self.age_ns(i) for i in range(len(self._feels))], self.mounting
        return JointState(
            tick=tick,
            timestamp_ns=timestamp_ns,
            angle_rad=mounting.joint_angle_rad(self.angle_rad).tolist(),
            velocity_rad_s=mounting.joint_velocity_rad_s(self.velocity_rad_s).tolist(),
            torque_nm=mounting.joint_torque_nm(self.torque_nm).tolist(),
            valid=[age <= lease_ns for age in ages],
            age_ns=ages,
        )

    def power(self, tick: int, timestamp_ns: int, lasts_ns: int) -> Power:
        """Supply and heat; what is older than `lasts_ns` is unknown."""
        now_ns = self._clock_ns()
        return Power(
            tick=tick,
            timestamp_ns=timestamp_ns,
            voltage_v=list(self._voltage_v),
            current_a=list(self._current_a),
            motor_c=list(self._motor_c),
            board_c=list(self._board_c),
            leak=[False] * len(self._health_ns),
            valid=[heard_ns != NEVER and now_ns - heard_ns <= lasts_ns for heard_ns in self._health_ns],
        )
