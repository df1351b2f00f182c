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
from snakesim_drivers.kit.findings import Finding
from snakesim_hal.wire.messages import Mode
from snakesim_serial_backend.feetech import registers as at
from snakesim_serial_backend.feetech.bring_up import bring_up
from snakesim_serial_backend.feetech.packets import SIGN_BIT, Packet, to_signed
from snakesim_serial_backend.feetech.servo import Servo
from snakesim_serial_backend.feetech.settings import FeetechSettings
from snakesim_serial_backend.servo_bus import Registers, SerialServos, ServoBusContext


@dataclass(frozen=True, kw_only=True)
class ServosContext(ServoBusContext[Servo, Packet]):
    """What the driver type gets to operate the servos of one port."""

    settings: FeetechSettings


class Servos(SerialServos[Servo, Packet]):
    """All servos of a port, tail to head."""

    motion: ClassVar[Registers] = Registers(at.PRESENT, at.present_form.size)
    state: ClassVar[Registers] = Registers(at.TORQUE_ENABLE, at.STATE_SIZE)
    health: ClassVar[Registers] = Registers(at.TORQUE_ENABLE, at.STATE_SIZE)
    torque_enable: ClassVar[int] = at.TORQUE_ENABLE

    def __init__(self, context: ServosContext) -> None:
        """Take over the servos of a port that is open; nothing is sent."""
        super().__init__(context)
        self._settings = context.settings
        self._max_pause_ns = round(context.settings.watchdog_s * 1e9)
        self._sent_ns: int | None = None  # when setpoints were last sent

    def bring_up(self) -> None:
        """Find all servos, check the registers that they keep, and write what differs. Torque is off, and stays off."""
        answers = bring_up(self.servos, self._port, self._settings)
        self._may_write = True
        self._sent_ns = None
        for i, (present, state) in enumerate(answers):
            servo = self.servos[i]
            servo.record_switch(follows=False, now_ns=self._clock_ns())
            servo.alone_s = 0.0
            self._readings.set_identity(i, firmware=servo.firmware)
            self.handle_answer(i, present)
            self._take_over_health(i, state)

    # --- reading ----------------------------------------------------------------------------------------------

    def read(self) -> None:
        """Read all servos, after a look at the clock: perhaps the driver was away."""
        self._note_pause()
        super().read()
        missing = [i for i in range(len(self.servos)) if i in self._silent]
        self._readings.require_check(missing)

    def _note_pause(self) -> None:
        """Record for how long servos held their last goal because the driver did not run."""
        now_ns = self._clock_ns()
        if self._sent_ns is None or now_ns - self._sent_ns <= self._max_pause_ns:
            return
        for servo in self.servos:
            if servo.follows:
                servo.alone_s = (now_ns - self._sent_ns) * 1e-9
        self._sent_ns = now_ns

    def handle_answer(self, i: int, status: Packet) -> None:
        """Put what a servo measures into the readings. Its torque is not measured."""
        servo = self.servos[i]
        position, speed, _load, voltage, temperature = at.present_form.unpack(status.data)
        speed_rad_s = to_signed(speed, SIGN_BIT) * self._settings.speed_unit_counts_s * at.RAD
        servo.errors = status.error
        self._readings.set_motion(i, at.to_angle_rad(to_signed(position, SIGN_BIT)), speed_rad_s)
        self._readings.set_supply(i, voltage * at.VOLTS, servo.current_a)
        self._readings.set_temperatures(i, float(temperature), float(temperature))

    def _take_over_health(self, i: int, status: Packet) -> None:
        """Store a servo's current and state; voltage and temperature come with its motion."""
        current = int.from_bytes(status.data[at.CURRENT - at.TORQUE_ENABLE :][:2], "little")
        self.servos[i].current_a = to_signed(current, SIGN_BIT) * at.CURRENT_A
        self._take_over_state(i, status)

    def _take_over_state(self, i: int, status: Packet) -> None:
        """Store whether a servo's torque is on, and whether it still has what was sent to it."""
        servo = self.servos[i]
        acceleration = status.data[at.ACCELERATION_ADDRESS - at.TORQUE_ENABLE]
        servo.enabled = status.data[0] == 1
        servo.errors = status.error
        servo.has_restarted = servo.follows and acceleration != at.ACCELERATION
        servo.health_ns = self._clock_ns()
        self._readings.mark_checked(i)

    # --- commands ---------------------------------------------------------------------------------------------

    def send_setpoints(self, command: BusCommand) -> None:
        """Send setpoints, and switch torque on and off as `Drives.send_setpoints` declares.

        An emergency stop switches the torque off, too: servos have no other stop. So does every mode but position.
        """
        self._note_pause()
        now_ns = self._clock_ns()
        self._sent_ns = now_ns
        all_servos = range(len(self.servos))
        holding = {i for i in command.following if command.modes[i] == Mode.POSITION}
        holding -= {i for i in all_servos if self.servos[i].alone_s or self.servos[i].has_restarted}
        if not command.may_enable:
            holding &= {i for i in all_servos if self.servos[i].follows}
        to_disable = [i for i in all_servos if i not in holding and (self.servos[i].follows or self.servos[i].enabled)]
        unchecked = self._readings.drives_to_check
        to_enable = sorted(i for i in holding - unchecked if not self.servos[i].follows)

        # A goal may switch the torque on by itself, so it comes with its torque limit, in one packet.
        self._write_same(at.TORQUE_ENABLE, to_disable, b"\0")
        self._write_same(at.ACCELERATION_ADDRESS, to_enable, bytes([at.ACCELERATION]))
        goals = [
            (self.servos[i].id, self._goal_registers(i, float(command.targets[i]), float(command.limits_nm[i])))
            for i in sorted(holding - unchecked)
        ]
        self._port.write_all(at.GOALS, goals)
        self._write_same(at.TORQUE_ENABLE, to_enable, b"\1")
        for i in to_disable:
            self.servos[i].record_switch(follows=False, now_ns=now_ns)
        for i in to_enable:
            self.servos[i].record_switch(follows=True, now_ns=now_ns)

    def _goal_registers(self, i: int, target_rad: float, limit_nm: float) -> bytes:
        """Return the goal registers of a position."""
        servo = self.servos[i]
        torque_limit = min(int(limit_nm / servo.stall_torque_nm * at.PER_MILLE), servo.max_per_mille)
        return at.goals_form.pack(at.to_position(target_rad), 0, 0, torque_limit)

    def reset_faults(self, joints: frozenset[int]) -> None:
        """Forget that servos were alone or have restarted. Their own errors end when the cause has gone."""
        for i in sorted(joints):
            servo = self.servos[i]
            servo.alone_s = 0.0
            if servo.has_restarted:
                self._write_same(at.TORQUE_ENABLE, [i], b"\0")
                servo.record_switch(follows=False, now_ns=self._clock_ns())
                servo.has_restarted = False

    def _find_state(self, i: int) -> Finding | None:
        servo = self.servos[i]
        if servo.errors:
            cause = f"{servo.label} reports {at.error_names(servo.errors)}"
            return Finding("drive_fault", cause, i, alone=True)
        if servo.alone_s:
            cause = (
                f"{servo.label} held its last angle for {servo.alone_s:.2f} s while the driver did not run, because it "
                "has no watchdog; now its torque is off"
            )
            return Finding("drive_fault", cause, i, alone=True)
        is_off = servo.follows and servo.health_ns > servo.switched_ns and not servo.enabled
        if servo.has_restarted or is_off:
            cause = f"{servo.label} does not follow: its torque was switched off, or it has restarted"
            return Finding("drive_not_armed", cause, i, alone=True)
        return None
