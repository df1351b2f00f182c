"""Dynamixel X servos as a driver type: a `snakesim_drivers.kit.drives.Drives`.

In every tick all servos report current, velocity and position in one fast sync read, one of them reports its health,
and all get goal current and goal position in one sync write.

The servos stay in current-based position mode. A torque is sent as that current, with a goal just out of reach in its
direction. Mode 0 would control torque alone, but a change of mode needs the torque off, and writes to memory that wears
out. A servo in mode 0 that loses its driver would also rotate without end. In the mode used here it stops just beyond
its travel.
"""

import struct
from dataclasses import dataclass
from typing import ClassVar

from snakesim_drivers.kit.drives import BusCommand
from snakesim_drivers.kit.findings import Finding
from snakesim_hal.wire.messages import Mode
from snakesim_serial_backend.dynamixel import registers as at
from snakesim_serial_backend.dynamixel.bring_up import bring_up
from snakesim_serial_backend.dynamixel.packets import Packet
from snakesim_serial_backend.dynamixel.port import Port
from snakesim_serial_backend.dynamixel.servo import REVOLUTION_RAD, SLACK_RAD, Servo
from snakesim_serial_backend.dynamixel.settings import DynamixelSettings
from snakesim_serial_backend.servo_bus import Registers, SerialServos, ServoBusContext


@dataclass(frozen=True, kw_only=True)
class ServosContext(ServoBusContext[Servo, Packet]):
    """What the driver type gets to operate the servos of one port."""

    port: Port
    settings: DynamixelSettings


class Servos(SerialServos[Servo, Packet]):
    """All servos of a port, tail to head."""

    motion: ClassVar[Registers] = Registers(at.PRESENT, at.present_form.size)
    state: ClassVar[Registers] = Registers(at.TORQUE_ENABLE, at.STATE_SIZE)
    health: ClassVar[Registers] = Registers(at.TORQUE_ENABLE, at.HEALTH_SIZE)
    torque_enable: ClassVar[int] = at.TORQUE_ENABLE

    def __init__(self, context: ServosContext) -> None:
        """Take over the servos of a port that is open; nothing is sent."""
        super().__init__(context)
        self._port: Port = context.port
        self._settings = context.settings
        self._watchdog = bytes([round(context.settings.watchdog_s / at.WATCHDOG_S)])

    def bring_up(self) -> None:
        """Find all servos, check the registers that they keep, and write what differs. Torque is off, and stays off."""
        answers = bring_up(self.servos, self._port, self._settings)
        self._may_write = True
        for i, (present, health) in enumerate(answers):
            self.handle_answer(i, present)
            self._take_over_health(i, health)

    def handle_answer(self, i: int, status: Packet) -> None:
        """Put what a servo measures into the readings."""
        servo = self.servos[i]
        current, velocity, position = at.present_form.unpack(status.data)
        angle_rad = position * at.RAD
        servo.booting_ns = -1
        servo.alert = status.alert
        if not status.alert:
            servo.errors = 0
        if not servo.follows:  # it may have restarted, and lost count of its revolutions
            turns = at.whole_turns(angle_rad, servo.lower_rad, servo.upper_rad, SLACK_RAD)
            if turns is not None:
                servo.turns = turns
        self._readings.set_motion(i, angle_rad + servo.turns * REVOLUTION_RAD, velocity * at.SPEED)
        self._readings.set_torque(i, current * servo.unit_nm)
        servo.current_a = abs(current) * servo.unit_nm / servo.constant

    def _take_over_health(self, i: int, status: Packet) -> None:
        """Put a servo's supply and temperature into the readings, and store its state."""
        self._take_over_state(i, status)
        data = status.data  # registers from TORQUE_ENABLE on
        (voltage,) = struct.unpack_from("<H", data, at.VOLTAGE - at.TORQUE_ENABLE)
        self._readings.set_supply(i, voltage * at.VOLTS, self.servos[i].current_a)
        temperature_c = float(data[at.TEMPERATURE - at.TORQUE_ENABLE])
        self._readings.set_temperatures(i, temperature_c, temperature_c)

    def _take_over_state(self, i: int, status: Packet) -> None:
        """Store whether a servo's torque is on, and what has switched it off."""
        servo = self.servos[i]
        data = status.data  # registers from TORQUE_ENABLE on
        servo.enabled = bool(data[0])
        servo.errors = data[at.HARDWARE_ERROR - at.TORQUE_ENABLE]
        servo.watchdog = data[at.WATCHDOG - at.TORQUE_ENABLE]
        servo.health_ns = self._clock_ns()
        self._readings.mark_checked(i)

    # --- commands ---------------------------------------------------------------------------------------------

    def send_setpoints(self, command: BusCommand) -> None:
        """Send setpoints, and switch torque on and off as `Drives.send_setpoints` declares.

        An emergency stop switches the torque off, too: servos have no other stop.
        """
        all_servos = range(len(self.servos))
        following = command.following
        if not command.may_enable:
            following &= {i for i in all_servos if self.servos[i].follows}
        to_disable = [
            i for i in all_servos if i not in following and (self.servos[i].follows or self.servos[i].enabled)
        ]
        to_enable = [i for i in all_servos if i in following and not self.servos[i].follows]

        # A servo gets its gains, its watchdog and its goal before its torque is switched on.
        self._write_same(at.TORQUE_ENABLE, to_disable, b"\0")
        if self._settings.write_gains:
            self._port.write_all(at.GAINS, [(self.servos[i].id, self.servos[i].gain_registers()) for i in to_enable])
        self._write_same(at.WATCHDOG, to_enable, b"\0")  # 0 clears a watchdog that has expired
        self._write_same(at.WATCHDOG, to_enable, self._watchdog)
        goals = [
            (
                self.servos[i].id,
                self._goal_registers(i, command.modes[i], command.targets[i], command.limits_nm[i]),
            )
            for i in all_servos
            if i in following
        ]
        self._port.write_all(at.GOALS, goals)
        self._write_same(at.TORQUE_ENABLE, to_enable, b"\1")
        for i in to_disable:
            self.servos[i].record_switch(follows=False, now_ns=self._clock_ns())
        for i in to_enable:
            self.servos[i].record_switch(follows=True, now_ns=self._clock_ns())

    def _goal_registers(self, i: int, mode: Mode, target: float, limit_nm: float) -> bytes:
        """Return the goal registers of a setpoint; a mode that servos do not have gets no current."""
        servo = self.servos[i]
        goal_rad = float(self._readings.angle_rad[i])
        match mode:
            case Mode.POSITION:
                goal_rad = target
            case Mode.TORQUE if target:
                goal_rad = servo.out_of_reach_rad(target)
                limit_nm = min(abs(target), limit_nm)
            case _:
                limit_nm = 0.0
        current = min(round(limit_nm / servo.unit_nm), servo.max_current)
        position = round((goal_rad - servo.turns * REVOLUTION_RAD) / at.RAD)
        return at.goals_form.pack(current, 0, 0, 0, position)

    def reset_faults(self, joints: frozenset[int]) -> None:
        """Restart servos with a hardware error, as nothing else clears it; a restart takes about half a second.

        A watchdog that has stopped its servo is cleared by writing 0.
        """
        for i in sorted(joints):
            servo = self.servos[i]
            if servo.watchdog == at.TRIPPED:
                self._write_same(at.WATCHDOG, [i], b"\0")
                servo.watchdog = 0
            if servo.errors or servo.alert:
                servo.port.reboot(servo.id)
                servo.errors = 0
                servo.alert = False
                servo.booting_ns = self._clock_ns()
                self._silent.add(i)

    def _find_state(self, i: int) -> Finding | None:
        servo = self.servos[i]
        if servo.errors:
            cause = f"{servo.label} reports {at.error_names(servo.errors)}; `snakesim robot reset` restarts it"
            return Finding("drive_fault", cause, i, alone=True)
        if servo.watchdog == at.TRIPPED:
            cause = f"{servo.label} was stopped by its bus watchdog, as it got no packet in time"
            return Finding("drive_fault", cause, i, alone=True)
        if servo.follows and servo.health_ns > servo.switched_ns and not servo.enabled:
            cause = f"{servo.label} does not follow: its torque is off: it has restarted"
            return Finding("drive_not_armed", cause, i, alone=True)
        return None
