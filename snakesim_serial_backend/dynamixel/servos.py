"""Dynamixel X servos as a driver type: a `snakesim_drivers.kit.drives.Drives`.

In every tick all servos report current, velocity and position in one fast sync read, one of them reports its health,
and all get goal current and goal position in one sync write.

The servos stay in current-based position mode. A torque is sent as that current, with a goal just out of reach in its
direction. Mode 0 would control torque alone, but a change of mode needs the torque off, and writes to memory that wears
out. A servo in mode 0 that loses its driver would also rotate without end. In the mode used here it stops just beyond
its travel.
"""

import struct
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from snakesim_drivers.emulation.emulated_body import FAULTS
from snakesim_drivers.kit.drives import BusCommand, Drives
from snakesim_drivers.kit.findings import Finding
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_hal.model.fault_kinds import Injection
from snakesim_hal.wire.messages import Mode
from snakesim_serial_backend.dynamixel import registers as at
from snakesim_serial_backend.dynamixel.bring_up import ANSWERS_TWICE, GARBLED, bring_up
from snakesim_serial_backend.dynamixel.emulator import EmulatedDynamixel
from snakesim_serial_backend.dynamixel.packets import Packet
from snakesim_serial_backend.dynamixel.port import Port
from snakesim_serial_backend.dynamixel.servo import REVOLUTION_RAD, SLACK_RAD, Servo
from snakesim_serial_backend.dynamixel.settings import DynamixelSettings
from snakesim_serial_backend.wire import is_emulated

BOOT_NS = 2_000_000_000  # in which the silence of a servo that restarts is no fault
INJECTABLE = {("bus", "cut"), *(("joint", kind) for kind in FAULTS)}
MAX_BAD_ANSWERS = 2  # in a row, doubled or garbled, until that is a fault: before `drive_silent`, which comes after 3
BUS_CUT = "nothing gets through; check the adapter, its cable and its power"


@dataclass(frozen=True)
class ServosContext:
    """What the driver type gets to operate the servos of one port."""

    servos: Sequence[Servo]  # of this port, from tail to head
    port: Port  # sends and receives packets
    readings: DriveReadings
    settings: DynamixelSettings
    emulator: EmulatedDynamixel | None  # the servos, if they are emulated in this process
    answer_s: float  # time that a reading waits for answers
    clock_ns: Callable[[], int]


class Servos(Drives):
    """All servos of a port, tail to head."""

    def __init__(self, context: ServosContext) -> None:
        """Take over the servos of a port that is open; nothing is sent."""
        self._emulator = context.emulator
        self.servos = list(context.servos)
        self.emulated = is_emulated(context.port.wire.port)
        self._port = context.port
        self._readings = context.readings
        self._settings = context.settings
        self._clock_ns = context.clock_ns
        self._answer_s = context.answer_s
        self._watchdog = bytes([round(context.settings.watchdog_s / at.WATCHDOG_S)])
        self._silent: set[int] = set()  # read one by one, as they would silence others in a sync read
        self._cycle = 0
        self._read_deadline_s = 0.0
        self._may_write = False  # until bring-up has checked that these are the servos of the robot

    def bring_up(self) -> None:
        """Find all servos, check the registers that they keep, and write what differs. Torque is off, and stays off."""
        answers = bring_up(self.servos, self._port, self._settings)
        self._may_write = True
        for i, (present, health) in enumerate(answers):
            self.handle_answer(i, present)
            self._take_over_health(i, health)

    # --- reading ----------------------------------------------------------------------------------------------

    def read(self) -> None:
        """Read all servos at once, one of the silent ones alone, and the health of one."""
        self._read_deadline_s = time.monotonic() + self._answer_s
        self._cycle += 1
        silent = sorted(self._silent)
        answering = [i for i in range(len(self.servos)) if i not in self._silent]
        self._read_states([i for i in answering if i in self._readings.drives_to_check])
        self._read_motion(answering)
        if silent:
            self._read_silent(silent[self._cycle % len(silent)])
        self._read_next_health([i for i in answering if i not in self._silent])
        for i, servo in enumerate(self.servos):
            if servo.booting_ns >= 0 and self._clock_ns() - servo.booting_ns < BOOT_NS:
                self._readings.skip_request(i)

    def _read_motion(self, indices: list[int]) -> None:
        """Read the motion of these servos at once.

        A silent servo silences all behind it. So the first one without an answer is left out, and the others are read
        again, as often as time allows.
        """
        missing = indices
        while missing and time.monotonic() < self._read_deadline_s:
            ids = [self.servos[i].id for i in missing]
            answers = self._port.read_all(ids, at.PRESENT, at.present_form.size)
            for i in missing:
                answer = answers.get(self.servos[i].id)
                if answer is not None:
                    self.handle_answer(i, answer)
            missing = [i for i in missing if self.servos[i].id not in answers]
            if missing:
                self._silent.add(missing.pop(0))

    def _read_silent(self, i: int) -> None:
        """Read the motion of a silent servo alone, and count answers that are doubled or garbled."""
        servo = self.servos[i]
        answers = servo.port.read_alone(servo.id, at.PRESENT, at.present_form.size)
        if answers.surplus:
            servo.answered_twice += 1
        else:
            servo.answered_twice = 0
        if answers.garbled and not answers.statuses:
            servo.garbled += 1
        else:
            servo.garbled = 0
        if answers.statuses and not answers.surplus:
            self._silent.clear()  # perhaps others answer again, too
            self.handle_answer(i, answers.statuses[-1])  # an earlier one is a late answer to an earlier request

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

    def _read_states(self, indices: Sequence[int]) -> None:
        """Read at once whether these servos have stopped by themselves; a silent one is read again later."""
        answers = self._port.read_all([self.servos[i].id for i in indices], at.TORQUE_ENABLE, at.STATE_SIZE)
        for i in indices:
            status = answers.get(self.servos[i].id)
            if status is not None:
                self._take_over_state(i, status)

    def _read_next_health(self, indices: list[int]) -> None:
        """Read the health of one of these servos: first of those with an alert whose error is unknown, in turn."""
        alarmed = [i for i in indices if self.servos[i].alert and not self.servos[i].errors]
        candidates = alarmed or indices
        if not candidates:
            return
        i = candidates[self._cycle % len(candidates)]
        servo = self.servos[i]
        status = servo.port.read(servo.id, at.TORQUE_ENABLE, at.HEALTH_SIZE)
        if status is not None:
            self._take_over_health(i, status)

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

    def poll(self) -> None:
        """Let servos that are emulated in this process run up to the present time."""
        self._port.wire.run_emulated_drives()

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

    def _write_same(self, address: int, indices: Sequence[int], data: bytes) -> None:
        """Write the same data to registers of several servos."""
        self._port.write_all(address, [(self.servos[i].id, data) for i in indices])

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

    # --- faults -----------------------------------------------------------------------------------------------

    def findings(self) -> list[Finding]:
        """Return what is wrong now with the port and its servos."""
        findings: list[Finding] = []
        error = self._port.wire.error()
        if error:
            findings.append(Finding("interface_down", f"{self._port.wire.port}: {error}; {BUS_CUT}"))
        for i, servo in enumerate(self.servos):
            for finding in (_answer_finding(i, servo), _state_finding(i, servo)):
                if finding is not None:
                    findings.append(finding)
        return findings

    def inject(self, injection: Injection, *, begins: bool) -> bool:
        """Begin or end a fault of emulated servos here, or of their bus. Returns whether it is possible."""
        if self._emulator is None or (injection.target_type, injection.kind) not in INJECTABLE:
            return False
        if injection.target_type == "joint":
            self._emulator.inject(injection, begins=begins)
        else:
            self._port.wire.cut(begins=begins)
        return True

    def close(self) -> None:
        """Switch the torque off, as far as the bus still works, and close the port."""
        try:
            if self._may_write:
                self._write_same(at.TORQUE_ENABLE, range(len(self.servos)), b"\0")
                self._port.wire.run_emulated_drives()
        finally:
            self._port.wire.close()
        if self._emulator is not None:
            self._emulator.close()


def _answer_finding(i: int, servo: Servo) -> Finding | None:
    """Return what is wrong with a servo's answers, if anything."""
    if servo.answered_twice >= MAX_BAD_ANSWERS:
        # It concerns the whole robot: which of the two servos is where is unknown.
        return Finding("duplicate_node", f"{servo.label} {ANSWERS_TWICE}", i)
    if servo.garbled >= MAX_BAD_ANSWERS:
        return Finding("drive_silent", f"{servo.label} sends garbled bytes: {GARBLED}", i, alone=True)
    return None


def _state_finding(i: int, servo: Servo) -> Finding | None:
    """Return what has switched a servo's torque off, if anything."""
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
