"""Dynamixel X servos as a driver type of drives: a `snakesim_drivers.kit.drives.Drives`.

Every tick all servos say current, velocity and position in one fast sync read, one of them says its health,
and all get goal current and goal position in one sync write. They stay in current-based position mode: a torque is that
current with a goal just out of reach in its direction. Mode 0 would be torque alone, but a change of mode needs the
torque off, and is a write to memory that wears out; and whoever has lost its driver turns on without end, in place of
to a stop just beyond its travel.
"""

import struct
import time
from collections.abc import Callable, Sequence

from snakesim_drivers.emulation.emulated_body import FAULTS
from snakesim_drivers.kit.findings import Finding
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.fault_kinds import Injection
from snakesim_hal.wire.messages import Mode
from snakesim_serial_backend.dynamixel import registers as at
from snakesim_serial_backend.dynamixel.bring_up import ANSWERS_TWICE, GARBLED, bring_up
from snakesim_serial_backend.dynamixel.emulator import EmulatedDynamixel
from snakesim_serial_backend.dynamixel.packets import Packet
from snakesim_serial_backend.dynamixel.port import Port
from snakesim_serial_backend.dynamixel.servo import SLACK_RAD, TURN, Servo
from snakesim_serial_backend.dynamixel.settings import DynamixelSettings
from snakesim_serial_backend.wire import is_emulated

BOOTS_WITHIN_NS = 2_000_000_000
INJECTED = {("bus", "cut"), *(("joint", kind) for kind in FAULTS)}
IN_A_ROW = 2  # questions answered twice, or in garbled bytes, until that is a fault: before `drive_silent`, after 3
BUS_CUT = "nothing gets through; check the adapter, its cable and its power"


class Servos:
    """All servos of a port, tail to head."""

    def __init__(
        self,
        servos: Sequence[Servo],
        port: Port,
        readings: DriveReadings,
        settings: DynamixelSettings,
        clock_ns: Callable[[], int],
        answer_s: float,
        emulator: EmulatedDynamixel | None,
    ) -> None:
        """emulator: the servos, if they are emulated here; answer_s: how long a tick waits for answers."""
        self._emulator, self.servos = emulator, list(servos)
        self.emulated = is_emulated(port.wire.port)
        self._port = port
        self._readings, self._settings, self._clock_ns, self._answer_s = readings, settings, clock_ns, answer_s
        self._watchdog = bytes([round(settings.watchdog_s / at.WATCHDOG_S)])
        self._lost: set[int] = set()  # silent: asked apart, as they would silence others
        self._turn, self._end_s = 0, 0.0
        self._ours = False  # whether they may be written to

    def bring_up(self) -> None:
        """Find all, check what they keep, write what differs. Torque is off, and stays so."""
        found = bring_up(self.servos, self._port, self._settings)
        self._ours = True
        for i, (present, health) in enumerate(found):
            self.handle_answer(i, present)
            self._check(i, health)

    # --- a tick -----------------------------------------------------------------------------------------------

    def read(self) -> None:
        """Ask all at once, one that was silent, and one for its health."""
        self._end_s = time.monotonic() + self._answer_s
        self._turn += 1
        everybody = range(len(self.servos))
        steady, silent = [i for i in everybody if i not in self._lost], sorted(self._lost)
        self._read_states([i for i in steady if i in self._readings.drives_to_check])
        self._ask(steady)
        if silent:
            self._ask_lost(silent[self._turn % len(silent)])
        if heard := [i for i in steady if i not in self._lost]:
            alarmed = [i for i in heard if self.servos[i].alert and not self.servos[i].errors]
            self._ask_health((alarmed or heard)[self._turn % len(alarmed or heard)])
        for i, servo in enumerate(self.servos):
            if servo.booting_ns >= 0 and self._clock_ns() - servo.booting_ns < BOOTS_WITHIN_NS:
                self._readings.skip_request(i)

    def _ask(self, left: list[int]) -> None:
        """All of these; without whoever is the first that is silent, as often as time allows."""
        while left and time.monotonic() < self._end_s:
            answers = self._port.read_all([self.servos[i].id for i in left], at.PRESENT, at.present_form.size)
            for i in left:
                if (answer := answers.get(self.servos[i].id)) is not None:
                    self.handle_answer(i, answer)
            left = [i for i in left if self.servos[i].id not in answers]
            if left:
                self._lost.add(left.pop(0))

    def _ask_lost(self, i: int) -> None:
        servo = self.servos[i]
        answers = servo.port.read_alone(servo.id, at.PRESENT, at.present_form.size)
        servo.answered_twice = servo.answered_twice + 1 if len(answers.statuses) > 1 else 0
        servo.garbled = servo.garbled + 1 if answers.garbled and not answers.statuses else 0
        if len(answers.statuses) == 1:
            self._lost.clear()  # perhaps others are back, too
            self.handle_answer(i, answers.statuses[0])

    def handle_answer(self, i: int, said: Packet) -> None:
        """What a servo measures."""
        servo = self.servos[i]
        current, velocity, position = at.present_form.unpack(said.data)
        angle_rad, servo.booting_ns, servo.alert = position * at.RAD, -1, said.alert
        if not said.alert:
            servo.errors = 0
        if not servo.follows:  # it may have restarted, and forgotten its turns
            turns = at.whole_turns(angle_rad, servo.lower_rad, servo.upper_rad, SLACK_RAD)
            servo.turns = servo.turns if turns is None else turns
        self._readings.set_motion(i, angle_rad + servo.turns * TURN, velocity * at.SPEED)
        self._readings.set_torque(i, current * servo.unit_nm)
        servo.current_a = abs(current) * servo.unit_nm / servo.constant

    def _read_states(self, which: Sequence[int]) -> None:
        """Read at once whether these servos have stopped by themselves; one that is silent is asked later."""
        answers = self._port.read_all([self.servos[i].id for i in which], at.TORQUE_ENABLE, at.STATE_SIZE)
        for i in which:
            if (said := answers.get(self.servos[i].id)) is not None:
                self._take_state(i, said)

    def _ask_health(self, i: int) -> None:
        servo = self.servos[i]
        if (said := servo.port.read(servo.id, at.TORQUE_ENABLE, at.HEALTH_SIZE)) is not None:
            self._check(i, said)

    def _check(self, i: int, said: Packet) -> None:
        """What a servo says of its health."""
        servo, data, first = self.servos[i], said.data, at.TORQUE_ENABLE
        self._take_state(i, said)
        volts = struct.unpack_from("<H", data, at.VOLTAGE - first)[0] * at.VOLTS
        self._readings.set_supply(i, volts, servo.current_a)
        temperature_c = float(data[at.TEMPERATURE - first])
        self._readings.set_temperatures(i, temperature_c, temperature_c)

    def _take_state(self, i: int, said: Packet) -> None:
        """Whether a servo's torque is on, and what has switched it off."""
        servo, data, first = self.servos[i], said.data, at.TORQUE_ENABLE
        servo.enabled = bool(data[0])
        servo.errors = data[at.HARDWARE_ERROR - first]
        servo.watchdog = data[at.WATCHDOG - first]
        servo.health_ns = self._clock_ns()
        self._readings.mark_checked(i)

    def poll(self) -> None:
        """Emulated servos."""
        self._port.wire.let_run()

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
        """Setpoints; torque on and off. An emergency stop is torque off, too: servos know no other."""
        everybody = range(len(self.servos))
        if not may_enable:
            following &= {i for i in everybody if self.servos[i].follows}
        off = [i for i in everybody if i not in following and (self.servos[i].follows or self.servos[i].enabled)]
        on = [i for i in everybody if i in following and not self.servos[i].follows]
        self._tell(at.TORQUE_ENABLE, off, b"\0")
        if self._settings.write_gains:
            self._port.write_all(at.GAINS, [(self.servos[i].id, self.servos[i].gains()) for i in on])
        self._tell(at.WATCHDOG, on, b"\0")
        self._tell(at.WATCHDOG, on, self._watchdog)
        goals = {i: self._goals(i, modes[i], targets[i], limits_nm[i]) for i in everybody if i in following}
        self._port.write_all(at.GOALS, [(self.servos[i].id, goal) for i, goal in goals.items()])
        self._tell(at.TORQUE_ENABLE, on, b"\1")
        for i in (*off, *on):
            self.servos[i].told(follows=i in on, now_ns=self._clock_ns())

    def _goals(self, i: int, mode: Mode, target: float, limit_nm: float) -> bytes:
        servo, goal_rad = self.servos[i], float(self._readings.angle_rad[i])
        match mode:
            case Mode.POSITION:
                goal_rad = target
            case Mode.TORQUE if target:
                goal_rad = servo.out_of_reach_rad(target)
                limit_nm = min(abs(target), limit_nm)
            case _:
                limit_nm = 0.0
        current = min(round(limit_nm / servo.unit_nm), servo.most_current)
        return at.goals_form.pack(current, 0, 0, 0, round((goal_rad - servo.turns * TURN) / at.RAD))

    def _tell(self, address: int, who: Sequence[int], data: bytes) -> None:
        self._port.write_all(address, [(self.servos[i].id, data) for i in who])

    def reset_faults(self, joints: frozenset[int]) -> None:
        """Restart who has a hardware error, as nothing else clears it; a restart takes about half a second.

        A watchdog that has stopped its servo is cleared by writing 0.
        """
        for i in sorted(joints):
            servo = self.servos[i]
            if servo.watchdog == at.TRIPPED:
                self._tell(at.WATCHDOG, [i], b"\0")
                servo.watchdog = 0
            if servo.errors or servo.alert:
                servo.port.reboot(servo.id)
                servo.errors, servo.alert, servo.booting_ns = 0, False, self._clock_ns()
                self._lost.add(i)

    def findings(self) -> list[Finding]:
        """Of port and servos."""
        found: list[Finding] = []
        if error := self._port.wire.error():
            found.append(Finding("interface_down", f"{self._port.wire.port}: {error}; {BUS_CUT}"))
        for i, servo in enumerate(self.servos):
            if servo.answered_twice >= IN_A_ROW:  # it concerns all: nothing is known of which of the two is where
                found.append(Finding("duplicate_node", f"{servo.who} {ANSWERS_TWICE}", i))
            elif servo.garbled >= IN_A_ROW:
                found.append(Finding("drive_silent", f"{servo.who} sends garbled bytes: {GARBLED}", i, alone=True))
            if servo.errors:
                cause = f"{servo.who} reports {at.error_names(servo.errors)}; a clear restarts it"
                found.append(Finding("drive_fault", cause, i, alone=True))
            elif servo.watchdog == at.TRIPPED:
                cause = f"{servo.who} was stopped by its bus watchdog, as it got no packet in time"
                found.append(Finding("drive_fault", cause, i, alone=True))
            elif servo.follows and servo.health_ns > servo.told_ns and not servo.enabled:
                cause = f"{servo.who} does not follow: its torque is off: it has restarted"
                found.append(Finding("drive_not_armed", cause, i, alone=True))
        return found

    def inject(self, injection: Injection, *, begins: bool) -> bool:
        """Faults of servos that are emulated here, and of their bus."""
        if self._emulator is None or (injection.target_type, injection.kind) not in INJECTED:
            return False
        if injection.target_type == "joint":
            self._emulator.inject(injection, begins=begins)
        else:
            self._port.wire.cut(begins=begins)
        return True

    def close(self) -> None:
        """Torque off, as far as the bus still works."""
        try:
            if self._ours:
                self._tell(at.TORQUE_ENABLE, range(len(self.servos)), b"\0")
                self._port.wire.let_run()
        finally:
            self._port.wire.close()
        if self._emulator is not None:
            self._emulator.close()
