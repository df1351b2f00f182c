"""Feetech STS servos as a driver type: a `snakesim_drivers.kit.drives.Drives`.

In every tick all servos report position, speed, voltage and temperature in one sync read, one of them reports its
state, and all that hold a position get goal and torque limit in one sync write.

The servos have no watchdog. Three rules take its place as far as a driver can:

* A driver that did not run for `watchdog_s` switches its servos off as soon as it runs again, and reports it.
* A servo that did not answer gets no goal before it has reported its state: it may have restarted, and a goal may
  switch its torque on.
* A joint that should be passive has its torque off.

If the host's process ends without closing, or the cable breaks, a servo holds its last goal. Nothing here changes that.
"""

from dataclasses import dataclass
from typing import ClassVar

from snakesim_drivers.kit.drives import BusCommand
from snakesim_drivers.kit.findings import FaultFinding
from snakesim_hal.wire.messages import JointMode
from snakesim_serial_backend.feetech import registers
from snakesim_serial_backend.feetech.bring_up import bring_up
from snakesim_serial_backend.feetech.packets import SIGN_BIT, FeetechPacket, decode_sign_magnitude
from snakesim_serial_backend.feetech.servo import FeetechServo
from snakesim_serial_backend.feetech.settings import FeetechSettings
from snakesim_serial_backend.servo_bus import RegisterRange, SerialServos, ServoBusContext


@dataclass(frozen=True, kw_only=True)
class FeetechContext(ServoBusContext[FeetechServo, FeetechPacket]):
    """What the driver type gets to operate the servos of one port."""

    settings: FeetechSettings


class FeetechServos(SerialServos[FeetechServo, FeetechPacket]):
    """All servos of a port, tail to head."""

    motion: ClassVar[RegisterRange] = RegisterRange(registers.PRESENT, registers.present_form.size)
    state: ClassVar[RegisterRange] = RegisterRange(registers.TORQUE_ENABLE, registers.STATE_SIZE)
    health: ClassVar[RegisterRange] = RegisterRange(registers.TORQUE_ENABLE, registers.STATE_SIZE)
    torque_enable: ClassVar[int] = registers.TORQUE_ENABLE

    def __init__(self, context: FeetechContext) -> None:
        """Prepare to drive the servos of a port that is open; nothing is sent."""
        super().__init__(context)
        self._settings = context.settings
        self._max_pause_ns = round(context.settings.watchdog_s * 1e9)
        self._last_setpoint_ns: int | None = None  # when setpoints were last sent

    def bring_up(self) -> None:
        """Find all servos, check their EEPROM registers, and write what differs. Torque is off afterwards."""
        responses = bring_up(self.servos, self._port, self._settings)
        self._is_brought_up = True
        self._last_setpoint_ns = None
        for i, (present, state) in enumerate(responses):
            servo = self.servos[i]
            servo.record_switch(is_torque_requested=False, now_ns=self._clock_ns())
            servo.unsupervised_s = 0.0
            self._readings.set_identity(i, firmware=servo.firmware)
            self.handle_response(i, present)
            self._store_health(i, state)

    # --- reading ----------------------------------------------------------------------------------------------

    def read(self) -> None:
        """Record a pause of the driver if there was one, then read all servos."""
        self._record_pause()
        super().read()
        missing = [i for i in range(len(self.servos)) if i in self._silent_servos]
        self._readings.require_check(missing)

    def _record_pause(self) -> None:
        """Record for how long servos held their last goal because the driver did not run."""
        now_ns = self._clock_ns()
        if self._last_setpoint_ns is None or now_ns - self._last_setpoint_ns <= self._max_pause_ns:
            return
        for servo in self.servos:
            if servo.is_torque_requested:
                servo.unsupervised_s = (now_ns - self._last_setpoint_ns) * 1e-9
        self._last_setpoint_ns = now_ns

    def handle_response(self, i: int, status: FeetechPacket) -> None:
        """Store the motion, voltage and temperature that a servo has reported in the readings."""
        servo = self.servos[i]
        position, speed, _load, voltage, temperature = registers.present_form.unpack(status.data)
        speed_rad_s = (
            decode_sign_magnitude(speed, SIGN_BIT)
            * self._settings.speed_unit_counts_s
            * registers.RAD
        )
        servo.errors = status.error
        self._readings.set_motion(
            i, registers.to_angle_rad(decode_sign_magnitude(position, SIGN_BIT)), speed_rad_s
        )
        self._readings.set_supply(i, voltage * registers.VOLTS, servo.current_a)
        self._readings.set_temperatures(i, float(temperature), float(temperature))

    def _store_health(self, i: int, status: FeetechPacket) -> None:
        """Store a servo's current and state; voltage and temperature come with its motion."""
        current = int.from_bytes(
            status.data[registers.CURRENT - registers.TORQUE_ENABLE :][:2], "little"
        )
        self.servos[i].current_a = decode_sign_magnitude(current, SIGN_BIT) * registers.CURRENT_A
        self._store_state(i, status)

    def _store_state(self, i: int, status: FeetechPacket) -> None:
        """Store whether a servo's torque is on, and whether it still has what was sent to it."""
        servo = self.servos[i]
        acceleration = status.data[registers.ACCELERATION_ADDRESS - registers.TORQUE_ENABLE]
        servo.enabled = status.data[0] == 1
        servo.errors = status.error
        servo.has_restarted = servo.is_torque_requested and acceleration != registers.ACCELERATION
        servo.health_read_ns = self._clock_ns()
        self._readings.mark_checked(i)

    # --- commands ---------------------------------------------------------------------------------------------

    def send_setpoints(self, command: BusCommand) -> None:
        """Switch torque off where it is not requested, send setpoints, and switch torque on where it is requested.

        An emergency stop switches the torque off, too: servos have no other stop. So does every mode but position. A
        servo that held its goal during a pause of the driver, or has restarted, stays off until the operator's reset.

        Args:
            command: Setpoints, and which servos are enabled.
        """
        self._record_pause()
        now_ns = self._clock_ns()
        self._last_setpoint_ns = now_ns
        all_servos = range(len(self.servos))
        position_servos = {
            i for i in command.enabled_drives if command.modes[i] == JointMode.POSITION
        }
        position_servos -= {
            i for i in all_servos if self.servos[i].unsupervised_s or self.servos[i].has_restarted
        }
        if not command.may_enable:
            position_servos &= {i for i in all_servos if self.servos[i].is_torque_requested}
        servos_to_disable = [
            i
            for i in all_servos
            if i not in position_servos
            and (self.servos[i].is_torque_requested or self.servos[i].enabled)
        ]
        unchecked_servos = self._readings.drives_to_check
        servos_to_enable = sorted(
            i for i in position_servos - unchecked_servos if not self.servos[i].is_torque_requested
        )

        # A goal may switch the torque on by itself, so it comes with its torque limit, in one packet.
        self._write_to_servos(registers.TORQUE_ENABLE, servos_to_disable, b"\0")
        self._write_to_servos(
            registers.ACCELERATION_ADDRESS, servos_to_enable, bytes([registers.ACCELERATION])
        )
        goals = [
            (
                self.servos[i].id,
                self._encode_goal_registers(
                    i, float(command.targets[i]), float(command.limits_nm[i])
                ),
            )
            for i in sorted(position_servos - unchecked_servos)
        ]
        self._port.write_all(registers.GOALS, goals)
        self._write_to_servos(registers.TORQUE_ENABLE, servos_to_enable, b"\1")
        for i in servos_to_disable:
            self.servos[i].record_switch(is_torque_requested=False, now_ns=now_ns)
        for i in servos_to_enable:
            self.servos[i].record_switch(is_torque_requested=True, now_ns=now_ns)

    def _encode_goal_registers(self, i: int, target_rad: float, limit_nm: float) -> bytes:
        """Return the goal registers of a position."""
        servo = self.servos[i]
        torque_limit = min(
            int(limit_nm / servo.stall_torque_nm * registers.PER_MILLE), servo.max_per_mille
        )
        return registers.goals_form.pack(registers.to_position(target_rad), 0, 0, torque_limit)

    def reset_faults(self, joints: frozenset[int]) -> None:
        """Forget pauses of the driver and restarts of servos. Errors that servos report end when their cause does."""
        for i in sorted(joints):
            servo = self.servos[i]
            servo.unsupervised_s = 0.0
            if servo.has_restarted:
                self._write_to_servos(registers.TORQUE_ENABLE, [i], b"\0")
                servo.record_switch(is_torque_requested=False, now_ns=self._clock_ns())
                servo.has_restarted = False

    def _find_stop_reason(self, i: int) -> FaultFinding | None:
        servo = self.servos[i]
        if servo.errors:
            cause = f"{servo.label} reports {registers.describe_errors(servo.errors)}"
            return FaultFinding("drive_fault", cause, i, affects_only_joint=True)
        if servo.unsupervised_s:
            cause = (
                f"{servo.label} held its last angle for {servo.unsupervised_s:.2f} s while the driver did not run, "
                "because it has no watchdog; now its torque is off"
            )
            return FaultFinding("drive_fault", cause, i, affects_only_joint=True)
        is_off = (
            servo.is_torque_requested
            and servo.health_read_ns > servo.torque_switched_ns
            and not servo.enabled
        )
        if servo.has_restarted or is_off:
            cause = (
                f"{servo.label} does not follow: its torque was switched off, or it has restarted"
            )
            return FaultFinding("drive_not_armed", cause, i, affects_only_joint=True)
        return None
