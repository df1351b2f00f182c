"""Emulated servos: control table, packets, refusals, alerts and bus watchdog of the X series, on a body that moves.

They do *not* simulate bit rate and delays of answers, profiles, the integral and feed-forward gains, PWM and velocity
limits, or encoder faults. Answers collide only when a second servo with the same id is injected. The scale of the
position law's gains is assumed, as the driver's is.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from snakesim_drivers.emulation.emulated_body import EmulatedBody
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
from snakesim_serial_backend.servo_backend import ServoEmulator
from snakesim_serial_backend.wire import Pty

MODEL = 1120  # XM540-W270, if the settings name no model
FIRMWARE = 46
MAX_CURRENT = 2047  # units of current
MAX_PWM = 885
FACTORY_DELAY = 250  # of an answer, in 2 us
ID_WITHOUT_SERVO = 255  # as secondary id: there is none
SECOND_SERVO_COUNTS = 1000  # how far from a servo a second one with its id is
SHUTDOWN_ERRORS = 0x34  # overload, electrical shock, overheating: these switch the torque off
OPERATING_MODES = (0, 1, 3, 4, 5, 16)
WRITABLE = [(7, 14), (20, 64), (64, 70), (76, 120)]  # addresses from, to

# Registers that only the emulator uses.
FIRMWARE_VERSION = 6
ID = 7
PROTOCOL = 13
MAX_TEMPERATURE = 31
PWM_LIMIT = 36
SHUTDOWN = 63
FIRST_GOAL = 100  # the goals of PWM, current, velocity and position follow each other


class EmulatedModel(NamedTuple):
    """The model that servos are emulated as."""

    number: int
    current_a: float  # in a unit of current


@dataclass
class EmulatedServo:
    """One servo: its control table, and what the table does not hold."""

    table: bytearray
    port: Pty
    unit_nm: float  # torque of one unit of current
    from_counts: int = 0  # angle at which its present position was 0 when it woke up
    fed_us: float = 0.0  # when it received its last packet
    held_counts: int | None = None  # where the watchdog has stopped it

    def read_register(self, form: str, address: int) -> int:
        """Return a register; form: its type for `struct`."""
        return struct.unpack_from("<" + form, self.table, address)[0]

    def write_register(self, form: str, address: int, value: int) -> None:
        """Set a register; form: its type for `struct`."""
        struct.pack_into("<" + form, self.table, address, value)

    @property
    def id(self) -> int:
        """The id to which the servo answers."""
        return self.table[ID]

    @property
    def on(self) -> bool:
        """Whether the torque is on."""
        return self.table[at.TORQUE_ENABLE] == 1


class EmulatedDynamixel(ServoEmulator):
    """All servos of a robot, at the other end of their ports."""

    def __init__(
        self,
        body: EmulatedBody,
        ports: Sequence[Pty],
        constants: Sequence[float],
        baud: int,
        clock_ns: Callable[[], int],
        model: EmulatedModel,
    ) -> None:
        """Make a servo for every joint of a body.

        Args:
            body: the body that the servos move.
            ports: the port of every joint's servo.
            constants: torque constant of every joint's servo, N·m/A.
            baud: baud rate that the servos are set to.
            clock_ns: a clock with any origin.
            model: the model of all servos.
        """
        self.servos: list[EmulatedServo] = []
        for joint, port, constant in zip(body.joints, ports, constants, strict=True):
            servo = EmulatedServo(bytearray(at.SIZE), port, model.current_a * constant)
            servo.write_register("H", at.MODEL, model.number)
            self._write_factory_settings(servo, joint.id, baud)
            servo.write_register("H", at.MIN_VOLTAGE, round(joint.limits.min_voltage_v / at.VOLTS))
            self.servos.append(servo)
        super().__init__(body, ports, clock_ns)
        self._decoders = [Decoder() for _ in self._bus_ends]
        self._delay_of_second = [FACTORY_DELAY] * len(self.servos)  # of a second servo with the id of one
        for i in range(len(self.servos)):
            self.restart(i)

    @staticmethod
    def _write_factory_settings(servo: EmulatedServo, id_: int, baud: int) -> None:
        """Set the registers that a servo keeps without power."""
        servo.table[FIRMWARE_VERSION] = FIRMWARE
        servo.table[ID] = id_
        servo.table[at.BAUD_RATE] = at.RATE[baud]
        servo.table[at.DELAY] = FACTORY_DELAY
        servo.table[at.OPERATING_MODE] = 3  # position
        servo.table[at.SECONDARY_ID] = ID_WITHOUT_SERVO
        servo.table[PROTOCOL] = 2
        servo.table[MAX_TEMPERATURE] = 80  # °C
        servo.write_register("H", PWM_LIMIT, MAX_PWM)
        servo.write_register("H", at.CURRENT_LIMIT, MAX_CURRENT)
        servo.table[SHUTDOWN] = SHUTDOWN_ERRORS

    def __call__(self) -> None:
        received = [port.receive() for port in self._bus_ends]  # may wait for the kernel, so it comes before the lock
        with self.body.lock:
            self.catch_up()
            for port, decoder, data in zip(self._bus_ends, self._decoders, received, strict=True):
                for packet in decoder.feed(data):
                    if packet.instruction != Instruction.STATUS:
                        self._handle_packet(port, packet)
            self.pass_time()

    # --- packets ----------------------------------------------------------------------------------------------

    def _handle_packet(self, port: Pty, packet: Packet) -> None:
        """Handle a packet for one servo or for several servos of a port."""
        listening = [i for i, servo in enumerate(self.servos) if servo.port is port and not self.body.is_booting(i)]
        index_of_id = {self.servos[i].id: i for i in listening}
        for i in listening:
            self.servos[i].fed_us = self.body.now_us
        parameters = packet.parameters
        match packet.instruction:
            case Instruction.SYNC_WRITE:
                self._write_several(parameters, index_of_id)
            case Instruction.SYNC_READ | Instruction.FAST_SYNC_READ:
                indices = [index_of_id.get(id_) for id_ in parameters[4:]]
                self._read_several(port, packet.instruction, parameters[:4], indices)
            case Instruction.PING if packet.id == EVERYBODY:
                for _, i in sorted(index_of_id.items()):
                    self._execute(i, packet.instruction, parameters)
            case instruction if packet.id in index_of_id:
                self._execute(index_of_id[packet.id], instruction, parameters)
            case _:
                pass

    def _execute(self, i: int, instruction: int, parameters: bytes) -> None:
        """Execute an instruction to one servo, and answer it."""
        servo = self.servos[i]
        match instruction:
            case Instruction.PING:
                self._answer(i, bytes(servo.table[:2]) + bytes([servo.table[FIRMWARE_VERSION]]))
            case Instruction.READ:
                data, refusal = self._read(i, parameters)
                self._answer(i, data, refusal, self._read_second(i, parameters))
            case Instruction.WRITE:
                (address,) = struct.unpack_from("<H", parameters)
                refusal = self._write(i, address, parameters[2:])
                self._answer(i, b"", refusal)
            case Instruction.REBOOT:
                self._answer(i, b"")
                self.body.start_boot(i)
                self.restart(i)
            case _:
                self._answer(i, b"", Refusal.INSTRUCTION)

    def _write_several(self, parameters: bytes, index_of_id: Mapping[int, int]) -> None:
        """Execute a sync write: address, size, and an id with data for each servo."""
        address, size = struct.unpack_from("<HH", parameters)
        for start in range(4, len(parameters), size + 1):
            i = index_of_id.get(parameters[start])
            if i is not None:
                self._write(i, address, parameters[start + 1 : start + 1 + size])

    def _read_several(self, port: Pty, instruction: int, registers: bytes, indices: Sequence[int | None]) -> None:
        """Answer a sync read in the order of its ids.

        Each servo waits for the one before it without end, so the first one that is silent ends the answer.

        Args:
            port: the port of the servos.
            instruction: SYNC_READ or FAST_SYNC_READ.
            registers: address and size, as in the packet.
            indices: the servo of each id in the packet; None for an id that no servo has.
        """
        parts: list[tuple[int, int, bytes]] = []  # error, id and data of each servo
        second_parts: list[tuple[int, int, bytes]] = []  # the same, with the data of a second servo with its id
        for i in indices:
            if i is None or self.body.is_silent(i):
                break
            data, refusal = self._read(i, registers)
            second_data = self._read_second(i, registers)
            if instruction == Instruction.SYNC_READ:
                self._answer(i, data, refusal, second_data)
            else:
                error = refusal | self._alert(i)
                parts.append((error, self.servos[i].id, data))
                second_parts.append((error, self.servos[i].id, second_data))
        if parts:
            port.send(collide(fast_status(parts, len(indices)), fast_status(second_parts, len(indices))))

    def _answer(self, i: int, data: bytes, refusal: int = 0, second_data: bytes | None = None) -> None:
        """Send a servo's status. second_data: the data of a second servo with its id, where they differ."""
        if self.body.is_silent(i):
            return
        servo = self.servos[i]
        error = bytes([refusal | self._alert(i)])
        status = encoded(servo.id, Instruction.STATUS, error + data)
        if not self.body.is_duplicated(i):
            servo.port.send(status)
            return
        if second_data is None:
            second_data = data
        second_status = encoded(servo.id, Instruction.STATUS, error + second_data)
        if servo.table[at.DELAY] == self._delay_of_second[i]:
            servo.port.send(collide(status, second_status))
        else:
            servo.port.send(status + second_status)

    def _alert(self, i: int) -> int:
        """Return the bit of a status that reports a hardware error."""
        if self.servos[i].table[at.HARDWARE_ERROR]:
            return ALERT
        return 0

    def _read(self, i: int, registers: bytes) -> tuple[bytes, int]:
        """Return the data of registers, and the refusal, 0 for none. registers: address and size."""
        address, size = struct.unpack("<HH", registers)
        if address + size > at.SIZE:
            return b"", Refusal.ACCESS
        self._measure(i)
        return bytes(self.servos[i].table[address : address + size]), 0

    def _read_second(self, i: int, registers: bytes) -> bytes:
        """Return the same registers of a second servo with the id of this one; without one, of the servo itself."""
        address, size = struct.unpack("<HH", registers)
        table = self.servos[i].table[:]
        if self.body.is_duplicated(i):
            (counts,) = struct.unpack_from("<i", table, at.PRESENT_POSITION)
            struct.pack_into("<i", table, at.PRESENT_POSITION, counts + SECOND_SERVO_COUNTS)
        return bytes(table[address : address + size])

    def _measure(self, i: int) -> None:
        """Update the registers of what a servo measures."""
        servo = self.servos[i]
        angle_rad, velocity_rad_s, torque_nm = self.body.read_shaft(i)
        voltage_v = self.body.read_supply(i)[0]
        temperature_c = self.body.read_temperatures(i)[0]
        current = max(min(round(torque_nm / servo.unit_nm), 32767), -32768)
        servo.write_register("h", at.PRESENT, current)
        servo.write_register("i", at.PRESENT_VELOCITY, round(velocity_rad_s / at.SPEED))
        servo.write_register("i", at.PRESENT_POSITION, round(angle_rad / at.RAD) - servo.from_counts)
        servo.write_register("H", at.VOLTAGE, round(voltage_v / at.VOLTS))
        servo.table[at.TEMPERATURE] = min(max(round(temperature_c), 0), 255)

    def _write(self, i: int, address: int, data: bytes) -> int:
        """Set registers, all of them or none, and return the refusal, 0 for none."""
        servo = self.servos[i]
        end = address + len(data)
        if not any(first <= address and end <= last for first, last in WRITABLE):
            return Refusal.ACCESS
        if address < at.TORQUE_ENABLE and servo.on:
            return Refusal.ACCESS
        table = servo.table[:]
        table[address:end] = data
        refusal = self._check_registers(servo, table, address, end)
        if refusal:
            return refusal
        servo.table = table
        if address <= at.DELAY < end and self.body.is_duplicated(i):
            self._delay_of_second[i] = table[at.DELAY]
        if address <= at.WATCHDOG < end and table[at.WATCHDOG] == 0:
            servo.held_counts = None
        self._drive(i)
        return 0

    @staticmethod
    def _check_registers(servo: EmulatedServo, table: bytearray, address: int, end: int) -> int:
        """Return the refusal of a write, 0 for none. table: the control table after it; address, end: what it sets."""
        after = EmulatedServo(table, servo.port, servo.unit_nm)
        sets_watchdog = address <= at.WATCHDOG < end
        sets_goals = address < at.GOAL_POSITION + 4 and end > FIRST_GOAL
        if servo.table[at.WATCHDOG] == at.TRIPPED and sets_goals:
            return Refusal.RANGE
        if table[at.OPERATING_MODE] not in OPERATING_MODES or (sets_watchdog and table[at.WATCHDOG] > 127):
            return Refusal.RANGE
        if table[at.TORQUE_ENABLE] > 1 or table[at.DELAY] > 254:
            return Refusal.RANGE
        if sets_goals and abs(after.read_register("h", at.GOALS)) > after.read_register("H", at.CURRENT_LIMIT):
            return Refusal.LIMIT
        if table[at.TORQUE_ENABLE] and servo.table[at.HARDWARE_ERROR] & servo.table[SHUTDOWN]:
            return Refusal.FAILED
        return 0

    # --- motors -----------------------------------------------------------------------------------------------

    def restart(self, i: int) -> None:
        """Reset all registers from address 64 on, and forget whole revolutions."""
        servo = self.servos[i]
        servo.table[at.TORQUE_ENABLE :] = bytes(at.SIZE - at.TORQUE_ENABLE)
        servo.table[at.STATUS_LEVEL] = 2
        servo.held_counts = None
        servo.write_register("H", at.P_GAIN, 800)
        servo.write_register("h", at.GOALS, servo.read_register("H", at.CURRENT_LIMIT))
        counts = round(self.body.read_shaft(i)[0] / at.RAD)
        servo.from_counts = counts // at.COUNTS * at.COUNTS
        self._measure(i)
        servo.write_register("i", at.GOAL_POSITION, servo.read_register("i", at.PRESENT_POSITION))
        self._drive(i)

    def _drive(self, i: int) -> None:
        """Drive the body in current-based position mode or in current mode, as the registers specify."""
        servo = self.servos[i]
        current = servo.read_register("h", at.GOALS)
        limit_nm = abs(current) * servo.unit_nm
        joint = self.body.joints[i]
        speed_rad_s = joint.limits.speed_rad_s * joint.drive.gear  # without a load
        mode = servo.table[at.OPERATING_MODE]
        if servo.on and mode == at.CURRENT_BASED_POSITION:
            d_gain = servo.read_register("H", at.GAINS)
            p_gain = servo.read_register("H", at.P_GAIN)
            stiffness, damping = at.law(d_gain, p_gain, servo.unit_nm)
            goal_counts = servo.held_counts
            if goal_counts is None:
                goal_counts = servo.read_register("i", at.GOAL_POSITION) + servo.from_counts
            self.body.drive_motor(i, Mode.POSITION, goal_counts * at.RAD, limit_nm, stiffness, damping, speed_rad_s)
        elif servo.on and mode == at.CURRENT_CONTROL:
            self.body.drive_motor(i, Mode.TORQUE, current * servo.unit_nm, limit_nm, 0.0, 0.0, speed_rad_s)
        else:
            self.body.drive_motor(i, Mode.PASSIVE, 0.0, 0.0, 0.0, 0.0, speed_rad_s)

    def on_step(self, now_us: float) -> None:
        """Let watchdogs expire, and detect servos that are too hot or have too little supply voltage."""
        for i, servo in enumerate(self.servos):
            watchdog = servo.table[at.WATCHDOG]
            if servo.on and 0 < watchdog != at.TRIPPED and now_us - servo.fed_us > watchdog * at.WATCHDOG_S * 1e6:
                servo.table[at.WATCHDOG] = at.TRIPPED
                servo.held_counts = round(self.body.read_shaft(i)[0] / at.RAD)
                self._drive(i)
            errors = self._detect_errors(i)
            if errors & ~servo.table[at.HARDWARE_ERROR]:
                servo.table[at.HARDWARE_ERROR] |= errors
                if errors & SHUTDOWN_ERRORS:
                    servo.table[at.TORQUE_ENABLE] = 0
                    self._drive(i)

    def _detect_errors(self, i: int) -> int:
        """Return the bits of the hardware errors that a servo has now."""
        errors = 0
        if self.body.is_too_hot(i):
            errors |= at.HardwareError.OVERHEATING
        min_voltage_v = self.servos[i].read_register("H", at.MIN_VOLTAGE) * at.VOLTS
        if self.body.read_supply(i)[0] < min_voltage_v:
            errors |= at.HardwareError.INPUT_VOLTAGE
        return errors


def collide(first: bytes, second: bytes) -> bytes:
    """Return what two servos that send at the same time leave on the line: a 0 of either wins."""
    longest = max(len(first), len(second))
    first = first.ljust(longest, b"\xff")
    second = second.ljust(longest, b"\xff")
    return bytes(a & b for a, b in zip(first, second, strict=True))
