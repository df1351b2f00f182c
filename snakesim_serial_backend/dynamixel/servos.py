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
from snakesim_drivers.kit.findings import FaultFinding
from snakesim_hal.wire.messages import JointMode
from snakesim_serial_backend.dynamixel import registers
from snakesim_serial_backend.dynamixel.bring_up import bring_up
from snakesim_serial_backend.dynamixel.packets import DynamixelPacket
from snakesim_serial_backend.dynamixel.port import DynamixelPort
from snakesim_serial_backend.dynamixel.servo import REVOLUTION_RAD, SLACK_RAD, DynamixelServo
from snakesim_serial_backend.dynamixel.settings import DynamixelSettings
from snakesim_serial_backend.servo_bus import RegisterRange, SerialServos, ServoBusContext


@dataclass(frozen=True, kw_only=True)
class DynamixelContext(ServoBusContext[DynamixelServo, DynamixelPacket]):
    """What the driver type gets to operate the servos of one port."""

    port: DynamixelPort
    settings: DynamixelSettings


class DynamixelServos(SerialServos[DynamixelServo, DynamixelPacket]):
    """All servos of a port, tail to head."""

    motion: ClassVar[RegisterRange] = RegisterRange(registers.PRESENT, registers.present_form.size)
    state: ClassVar[RegisterRange] = RegisterRange(registers.TORQUE_ENABLE, registers.STATE_SIZE)
    health: ClassVar[RegisterRange] = RegisterRange(registers.TORQUE_ENABLE, registers.HEALTH_SIZE)
    torque_enable: ClassVar[int] = registers.TORQUE_ENABLE

    def __init__(self, context: DynamixelContext) -> None:
        """Prepare to drive the servos of a port that is open; nothing is sent."""
        super().__init__(context)
        self._port: DynamixelPort = context.port
        self._settings = context.settings
        self._watchdog_register = bytes([round(context.settings.watchdog_s / registers.WATCHDOG_S)])

    def bring_up(self) -> None:
        """Find all servos, check their EEPROM registers, and write what differs. Torque is off afterwards."""
        responses = bring_up(self.servos, self._port, self._settings)
        self._is_brought_up = True
        for i, (present, health) in enumerate(responses):
            self.handle_response(i, present)
            self._store_health(i, health)

    def handle_response(self, i: int, status: DynamixelPacket) -> None:
        """Store the motion and torque that a servo has reported in the readings."""
        servo = self.servos[i]
        current, velocity, position = registers.present_form.unpack(status.data)
        angle_rad = position * registers.RAD
        servo.boot_start_ns = -1
        servo.alert = status.alert
        if not status.alert:
            servo.errors = 0
        # It may have restarted, and lost count of its revolutions.
        if not servo.is_torque_requested:
            turns = registers.find_whole_turns(
                angle_rad, servo.lower_rad, servo.upper_rad, SLACK_RAD
            )
            if turns is not None:
                servo.turns = turns
        self._readings.set_motion(
            i, angle_rad + servo.turns * REVOLUTION_RAD, velocity * registers.SPEED
        )
        self._readings.set_torque(i, current * servo.torque_unit_nm)
        servo.current_a = abs(current) * servo.torque_unit_nm / servo.torque_constant_nm_per_a

    def _store_health(self, i: int, status: DynamixelPacket) -> None:
        """Store a servo's supply and temperature in the readings, and also its state."""
        self._store_state(i, status)
        data = status.data  # registers from TORQUE_ENABLE on
        (voltage,) = struct.unpack_from("<H", data, registers.VOLTAGE - registers.TORQUE_ENABLE)
        self._readings.set_supply(i, voltage * registers.VOLTS, self.servos[i].current_a)
        temperature_c = float(data[registers.TEMPERATURE - registers.TORQUE_ENABLE])
        self._readings.set_temperatures(i, temperature_c, temperature_c)

    def _store_state(self, i: int, status: DynamixelPacket) -> None:
        """Store whether a servo's torque is on, and what has switched it off."""
        servo = self.servos[i]
        data = status.data  # registers from TORQUE_ENABLE on
        servo.enabled = bool(data[0])
        servo.errors = data[registers.HARDWARE_ERROR - registers.TORQUE_ENABLE]
        servo.watchdog = data[registers.WATCHDOG - registers.TORQUE_ENABLE]
        servo.health_read_ns = self._clock_ns()
        self._readings.mark_checked(i)

    # --- commands ---------------------------------------------------------------------------------------------

    def send_setpoints(self, command: BusCommand) -> None:
        """Switch torque off where it is not requested, send setpoints, and switch torque on where it is requested.

        An emergency stop switches the torque off, too: servos have no other stop.

        Args:
            command: Setpoints, and which servos are enabled.
        """
        all_servos = range(len(self.servos))
        enabled_drives = command.enabled_drives
        if not command.may_enable:
            enabled_drives &= {i for i in all_servos if self.servos[i].is_torque_requested}
        servos_to_disable = [
            i
            for i in all_servos
            if i not in enabled_drives
            and (self.servos[i].is_torque_requested or self.servos[i].enabled)
        ]
        servos_to_enable = [
            i for i in all_servos if i in enabled_drives and not self.servos[i].is_torque_requested
        ]

        # A servo gets its gains, its watchdog and its goal before its torque is switched on.
        self._write_to_servos(registers.TORQUE_ENABLE, servos_to_disable, b"\0")
        if self._settings.write_gains:
            self._port.write_all(
                registers.GAINS,
                [
                    (self.servos[i].id, self.servos[i].encode_gain_registers())
                    for i in servos_to_enable
                ],
            )
        # 0 clears a watchdog that has expired.
        self._write_to_servos(registers.WATCHDOG, servos_to_enable, b"\0")
        self._write_to_servos(registers.WATCHDOG, servos_to_enable, self._watchdog_register)
        goals = [
            (
                self.servos[i].id,
                self._encode_goal_registers(
                    i, command.modes[i], command.targets[i], command.limits_nm[i]
                ),
            )
            for i in all_servos
            if i in enabled_drives
        ]
        self._port.write_all(registers.GOALS, goals)
        self._write_to_servos(registers.TORQUE_ENABLE, servos_to_enable, b"\1")
        for i in servos_to_disable:
            self.servos[i].record_switch(is_torque_requested=False, now_ns=self._clock_ns())
        for i in servos_to_enable:
            self.servos[i].record_switch(is_torque_requested=True, now_ns=self._clock_ns())

    def _encode_goal_registers(
        self, i: int, mode: JointMode, target: float, limit_nm: float
    ) -> bytes:
        """Return the goal registers of a setpoint; a mode that servos do not have gets no current."""
        servo = self.servos[i]
        goal_rad = float(self._readings.angle_rad[i])
        match mode:
            case JointMode.POSITION:
                goal_rad = target
            case JointMode.TORQUE if target:
                goal_rad = servo.out_of_reach_rad(target)
                limit_nm = min(abs(target), limit_nm)
            case _:
                limit_nm = 0.0
        current = min(round(limit_nm / servo.torque_unit_nm), servo.max_current)
        position = round((goal_rad - servo.turns * REVOLUTION_RAD) / registers.RAD)
        return registers.goals_form.pack(current, 0, 0, 0, position)

    def reset_faults(self, joints: frozenset[int]) -> None:
        """Restart servos with a hardware error, as nothing else clears it; a restart takes about half a second.

        A watchdog that has stopped its servo is cleared by writing 0.
        """
        for i in sorted(joints):
            servo = self.servos[i]
            if servo.watchdog == registers.TRIPPED:
                self._write_to_servos(registers.WATCHDOG, [i], b"\0")
                servo.watchdog = 0
            if servo.errors or servo.alert:
                servo.port.reboot(servo.id)
                servo.errors = 0
                servo.alert = False
                servo.boot_start_ns = self._clock_ns()
                self._silent_servos.add(i)

    def _find_stop_reason(self, i: int) -> FaultFinding | None:
        servo = self.servos[i]
        if servo.errors:
            cause = (
                f"{servo.label} reports {registers.describe_errors(servo.errors)}; `snakesim "
                "robot reset` restarts it"
            )
            return FaultFinding("drive_fault", cause, i, affects_only_joint=True)
        if servo.watchdog == registers.TRIPPED:
            cause = f"{servo.label} was stopped by its bus watchdog, as it got no packet in time"
            return FaultFinding("drive_fault", cause, i, affects_only_joint=True)
        if (
            servo.is_torque_requested
            and servo.health_read_ns > servo.torque_switched_ns
            and not servo.enabled
        ):
            cause = f"{servo.label} does not follow: its torque is off: it has restarted"
            return FaultFinding("drive_not_armed", cause, i, affects_only_joint=True)
        return None
