"""Emulated servos: control table, packets, refusals, alerts and bus watchdog of the X series, on a body that moves.

They do *not* simulate bit rate and delays of answers, collisions, profiles, the integral and feed-forward gains, PWM
and velocity limits, encoder faults. The scale of the position law's gains is assumed, as the driver's is.
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from snakesim_drivers.emulation.emulated_body import DriveEmulator, EmulatedBody
from snakesim_hal.wire.messages import Mode
from snakesim_serial_backend.dynamixel import registers as at
from snakesim_serial_backend.dynamixel.packets import (
    ALERT,
    EVERYBODY,
    Decoder,
    Instruction,
    Packet,
    Refusal,
    encoded,
    fast_status,
)
from snakesim_serial_backend.wire import Pty

MODEL, FIRMWARE = 1120, 46  # XM540-W270
CURRENT_A = 0.00269
MOST_CURRENT = 2047
PWM_LIMIT, MOST_PWM = 36, 885
FACTORY_DELAY = 250  # of an answer, in 2 us
ELSEWHERE_COUNTS = 1000  # how far from a servo a second one with its id is
SHUTDOWN, SHUTDOWN_BY = 63, 0x34  # overload, electrical shock, overheating
MODES = (0, 1, 3, 4, 5, 16)
WRITABLE = [(7, 14), (20, 64), (64, 70), (76, 120)]  # addresses from, to


@dataclass
class Servo:
    """One servo: its table, and what is not in it."""

    table: bytearray
    port: Pty
    unit_nm: float
    from_counts: int = 0  # what its turns count from, since it woke up
    fed_us: float = 0.0
    held_counts: int | None = None  # where the watchdog has stopped it

    def get(self, form: str, address: int) -> int:
        """A register."""
        return struct.unpack_from("<" + form, self.table, address)[0]

    def put(self, form: str, address: int, value: int) -> None:
        """Set a register."""
        struct.pack_into("<" + form, self.table, address, value)

    @property
    def id(self) -> int:
        """Its id."""
        return self.table[7]

    @property
    def on(self) -> bool:
        """Whether its torque is on."""
        return self.table[at.TORQUE_ENABLE] == 1


class EmulatedDynamixel(DriveEmulator):
    """All servos of a robot, at the other end of their ports."""

    def __init__(
        self,
        body: EmulatedBody,
        ports: Sequence[Pty],
        constants: Sequence[float],
        baud: int,
        clock_ns: Callable[[], int],
    ) -> None:
        """ports: of every joint; constants: torque constants, N·m/A; clock_ns: the time, since anything."""
        self.servos: list[Servo] = []
        for joint, port, constant in zip(body.joints, ports, constants, strict=True):
            servo = Servo(bytearray(at.SIZE), port, CURRENT_A * constant)
            servo.put("H", at.MODEL, MODEL)
            servo.table[6], servo.table[7], servo.table[8] = FIRMWARE, joint.id, at.RATE[baud]
            servo.table[at.DELAY], servo.table[at.OPERATING_MODE], servo.table[13] = FACTORY_DELAY, 3, 2
            servo.table[at.SECONDARY_ID] = 255
            servo.put("H", PWM_LIMIT, MOST_PWM)
            servo.table[31], servo.table[SHUTDOWN] = 80, SHUTDOWN_BY
            servo.put("H", at.LEAST_VOLTAGE, round(joint.limits.min_voltage_v / at.VOLTS))
            servo.put("H", at.CURRENT_LIMIT, MOST_CURRENT)
            self.servos.append(servo)
        super().__init__(body, ports, clock_ns)
        self._decoders = [Decoder() for _ in self._ends]
        self._delay_of_second = [FACTORY_DELAY] * len(self.servos)  # of a second servo with the id of one
        for i in range(len(self.servos)):
            self.restart(i)

    def __call__(self) -> None:
        """Handle what has arrived, and let time pass up to now."""
        taken = [port.take() for port in self._ends]  # may wait for the kernel; nobody else has to wait for it
        with self.body.lock:
            self.catch_up()
            for port, decoder, data in zip(self._ends, self._decoders, taken, strict=True):
                for packet in decoder.feed(data):
                    if packet.instruction != Instruction.STATUS:
                        self._take(port, packet)
            self.pass_time()

    # --- packets ----------------------------------------------------------------------------------------------

    def _take(self, port: Pty, packet: Packet) -> None:
        mine = [i for i, servo in enumerate(self.servos) if servo.port is port and not self.body.is_booting(i)]
        by_id = {self.servos[i].id: i for i in mine}
        for i in mine:
            self.servos[i].fed_us = self.body.now_us
        given = packet.parameters
        match packet.instruction:
            case Instruction.SYNC_WRITE:
                address, size = struct.unpack_from("<HH", given)
                for start in range(4, len(given), size + 1):
                    if (i := by_id.get(given[start])) is not None:
                        self._write(i, address, given[start + 1 : start + 1 + size])
            case Instruction.SYNC_READ | Instruction.FAST_SYNC_READ:
                self._read_all(port, packet.instruction, given[:4], [by_id.get(id_) for id_ in given[4:]])
            case Instruction.PING if packet.id == EVERYBODY:
                for _, i in sorted(by_id.items()):
                    self._obey(i, packet.instruction, given)
            case instruction if packet.id in by_id:
                self._obey(by_id[packet.id], instruction, given)
            case _:
                pass

    def _obey(self, i: int, instruction: int, given: bytes) -> None:
        """What one servo is told, or asked for."""
        match instruction:
            case Instruction.PING:
                self._answer(i, bytes(self.servos[i].table[:2]) + bytes([self.servos[i].table[6]]))
            case Instruction.READ:
                data, refusal = self._read(i, given)
                self._answer(i, data, refusal, self._read_second(i, given))
            case Instruction.WRITE:
                self._answer(i, b"", self._write(i, struct.unpack_from("<H", given)[0], given[2:]))
            case Instruction.REBOOT:
                self._answer(i, b"")
                self.body.start_boot(i)
                self.restart(i)
            case _:
                self._answer(i, b"", Refusal.INSTRUCTION)

    def _read_all(self, port: Pty, instruction: int, what: bytes, asked: Sequence[int | None]) -> None:
        """In the order of their ids in the packet: each waits for the one before it, for ever."""
        parts: list[tuple[int, int, bytes]] = []
        seconds: list[tuple[int, int, bytes]] = []  # the same, with what a second servo of an id puts there
        for i in asked:
            if i is None or self.body.is_silent(i):
                break
            data, refusal = self._read(i, what)
            second = self._read_second(i, what)
            if instruction == Instruction.SYNC_READ:
                self._answer(i, data, refusal, second)
            else:
                parts.append((refusal | self._alert(i), self.servos[i].id, data))
                seconds.append((refusal | self._alert(i), self.servos[i].id, second))
        if parts:
            port.give(collided(fast_status(parts, len(asked)), fast_status(seconds, len(asked))))

    def _answer(self, i: int, data: bytes, refusal: int = 0, second: bytes | None = None) -> None:
        """Give a servo's status. second: the data of a second servo with its id, where they differ."""
        if self.body.is_silent(i):
            return
        servo, error = self.servos[i], bytes([refusal | self._alert(i)])
        status = encoded(servo.id, Instruction.STATUS, error + data)
        if not self.body.is_doubled(i):
            servo.port.give(status)
            return
        other = encoded(servo.id, Instruction.STATUS, error + (data if second is None else second))
        if servo.table[at.DELAY] == self._delay_of_second[i]:
            servo.port.give(collided(status, other))
        else:
            servo.port.give(status + other)

    def _alert(self, i: int) -> int:
        return ALERT if self.servos[i].table[at.HARDWARE_ERROR] else 0

    def _read(self, i: int, what: bytes) -> tuple[bytes, int]:
        address, size = struct.unpack("<HH", what)
        if address + size > at.SIZE:
            return b"", Refusal.ACCESS
        self._measure(i)
        return bytes(self.servos[i].table[address : address + size]), 0

    def _read_second(self, i: int, what: bytes) -> bytes:
        """The same registers of a second servo with the id of this one; without one, of the servo itself."""
        address, size = struct.unpack("<HH", what)
        table = self.servos[i].table[:]
        if self.body.is_doubled(i):
            (counts,) = struct.unpack_from("<i", table, at.PRESENT + 6)
            struct.pack_into("<i", table, at.PRESENT + 6, counts + ELSEWHERE_COUNTS)
        return bytes(table[address : address + size])

    def _measure(self, i: int) -> None:
        servo, (angle_rad, velocity_rad_s, torque_nm) = self.servos[i], self.body.read_shaft(i)
        servo.put("h", at.PRESENT, max(min(round(torque_nm / servo.unit_nm), 32767), -32768))
        servo.put("i", at.PRESENT + 2, round(velocity_rad_s / at.SPEED))
        servo.put("i", at.PRESENT + 6, round(angle_rad / at.RAD) - servo.from_counts)
        servo.put("H", at.VOLTAGE, round(self.body.read_supply(i)[0] / at.VOLTS))
        servo.table[at.TEMPERATURE] = min(max(round(self.body.read_temperatures(i)[0]), 0), 255)

    def _write(self, i: int, address: int, data: bytes) -> int:
        """Set registers, all of them or none; why not."""
        servo, end = self.servos[i], address + len(data)
        if not any(first <= address and end <= last for first, last in WRITABLE):
            return Refusal.ACCESS
        if address < at.TORQUE_ENABLE and servo.on:
            return Refusal.ACCESS
        after = servo.table[:]
        after[address:end] = data
        if why := self._refusal(servo, after, address, end):
            return why
        servo.table = after
        if address <= at.DELAY < end and self.body.is_doubled(i):
            self._delay_of_second[i] = after[at.DELAY]
        if address <= at.WATCHDOG < end and after[at.WATCHDOG] == 0:
            servo.held_counts = None
        self._drive(i)
        return 0

    @staticmethod
    def _refusal(servo: Servo, after: bytearray, address: int, end: int) -> int:
        new = Servo(after, servo.port, servo.unit_nm)
        goals = address < at.GOAL_POSITION + 4 and end > 100
        if servo.table[at.WATCHDOG] == at.TRIPPED and goals:
            return Refusal.RANGE
        if after[at.OPERATING_MODE] not in MODES or (address <= at.WATCHDOG < end and after[at.WATCHDOG] > 127):
            return Refusal.RANGE
        if after[at.TORQUE_ENABLE] > 1 or after[at.DELAY] > 254:
            return Refusal.RANGE
        if goals and abs(new.get("h", at.GOALS)) > new.get("H", at.CURRENT_LIMIT):
            return Refusal.LIMIT
        shut = servo.table[at.HARDWARE_ERROR] & servo.table[SHUTDOWN]
        return Refusal.FAILED if after[at.TORQUE_ENABLE] and shut else 0

    # --- motors -----------------------------------------------------------------------------------------------

    def restart(self, i: int) -> None:
        """Everything from address 64 on is as at first, and the turns are forgotten."""
        servo = self.servos[i]
        servo.table[at.TORQUE_ENABLE :] = bytes(at.SIZE - at.TORQUE_ENABLE)
        servo.table[at.STATUS_LEVEL], servo.held_counts = 2, None
        servo.put("H", at.GAINS + 4, 800)
        servo.put("h", at.GOALS, servo.get("H", at.CURRENT_LIMIT))
        servo.from_counts = round(self.body.read_shaft(i)[0] / at.RAD) // at.COUNTS * at.COUNTS
        self._measure(i)
        servo.put("i", at.GOAL_POSITION, servo.get("i", at.PRESENT + 6))
        self._drive(i)

    def _drive(self, i: int) -> None:
        """Current-based position; of the other modes current, and none else moves."""
        servo = self.servos[i]
        mode, d, p = servo.table[at.OPERATING_MODE], servo.get("H", at.GAINS), servo.get("H", at.GAINS + 4)
        current, goal = servo.get("h", at.GOALS), servo.get("i", at.GOAL_POSITION)
        stiffness, damping = at.law(d, p, servo.unit_nm)
        goal_rad = (goal + servo.from_counts if servo.held_counts is None else servo.held_counts) * at.RAD
        limit_nm, joint = abs(current) * servo.unit_nm, self.body.joints[i]
        speed_rad_s = joint.limits.speed_rad_s * joint.drive.gear  # without a load
        if servo.on and mode == at.CURRENT_BASED_POSITION:
            self.body.drive_motor(i, Mode.POSITION, goal_rad, limit_nm, stiffness, damping, speed_rad_s)
        elif servo.on and mode == 0:
            self.body.drive_motor(i, Mode.TORQUE, current * servo.unit_nm, limit_nm, 0.0, 0.0, speed_rad_s)
        else:
            self.body.drive_motor(i, Mode.PASSIVE, 0.0, 0.0, 0.0, 0.0, speed_rad_s)

    def on_step(self, now_us: float) -> None:
        """Watchdogs, heat and supply."""
        for i, servo in enumerate(self.servos):
            watchdog = servo.table[at.WATCHDOG]
            if servo.on and 0 < watchdog != at.TRIPPED and now_us - servo.fed_us > watchdog * at.WATCHDOG_S * 1e6:
                servo.table[at.WATCHDOG] = at.TRIPPED
                servo.held_counts = round(self.body.read_shaft(i)[0] / at.RAD)
                self._drive(i)
            hot = at.HardwareError.OVERHEATING if self.body.is_too_hot(i) else 0
            weak = self.body.read_supply(i)[0] < servo.get("H", at.LEAST_VOLTAGE) * at.VOLTS
            found = hot | (at.HardwareError.INPUT_VOLTAGE if weak else 0)
            if found & ~servo.table[at.HARDWARE_ERROR]:
                servo.table[at.HARDWARE_ERROR] |= found
                if found & SHUTDOWN_BY:
                    servo.table[at.TORQUE_ENABLE] = 0
                    self._drive(i)


def collided(one: bytes, other: bytes) -> bytes:
    """Return what two servos that send at the same time leave on the line: a 0 of either wins."""
    longest = max(len(one), len(other))
    return bytes(a & b for a, b in zip(one.ljust(longest, b"\xff"), other.ljust(longest, b"\xff"), strict=True))
