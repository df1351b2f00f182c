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
from snakesim_hal.wire.messages import JointMode
from snakesim_serial_backend.dynamixel import registers
from snakesim_serial_backend.dynamixel.packets import (
    ALERT,
    BROADCAST_ID,
    DynamixelDecoder,
    DynamixelErrorCode,
    DynamixelInstruction,
    DynamixelPacket,
    encode_fast_status,
    encode_packet,
)
from snakesim_serial_backend.servo_backend import ServoEmulator
from snakesim_serial_backend.wire import PseudoTerminal

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
class EmulatedDynamixelServo:
    """One servo: its control table, and what the table does not hold."""

    table: bytearray
    port: PseudoTerminal
    torque_unit_nm: float  # torque of one unit of current
    turn_offset_counts: int = 0  # angle at which its present position was 0 when it woke up
    last_packet_us: float = 0.0  # when it received its last packet
    hold_position_counts: int | None = None  # where the watchdog has stopped it

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
    def is_torque_on(self) -> bool:
        """Whether the torque is on."""
        return self.table[registers.TORQUE_ENABLE] == 1


class EmulatedDynamixel(ServoEmulator):
    """All servos of a robot, at the other end of their ports."""

    def __init__(
        self,
        body: EmulatedBody,
        ports: Sequence[PseudoTerminal],
        torque_constants_nm_per_a: Sequence[float],
        baud: int,
        clock_ns: Callable[[], int],
        model: EmulatedModel,
    ) -> None:
        """Create an emulated servo for every joint of a body.

        Args:
            body: Body that the servos move.
            ports: Pseudo terminal of every joint's servo; servos of one port have the same object.
            torque_constants_nm_per_a: Torque constant of every joint's servo in N·m/A.
            baud: Baud rate that the servos are set to, in bit/s.
            clock_ns: Function that returns a steady time in ns, with any origin.
            model: Model of all servos.
        """
        self.servos: list[EmulatedDynamixelServo] = []
        for joint, port, torque_constant_nm_per_a in zip(
            body.joints, ports, torque_constants_nm_per_a, strict=True
        ):
            servo = EmulatedDynamixelServo(
                bytearray(registers.SIZE), port, model.current_a * torque_constant_nm_per_a
            )
            servo.write_register("H", registers.MODEL, model.number)
            self._write_factory_settings(servo, joint.id, baud)
            servo.write_register(
                "H", registers.MIN_VOLTAGE, round(joint.limits.min_voltage_v / registers.VOLTS)
            )
            self.servos.append(servo)
        super().__init__(body, ports, clock_ns)
        self._decoders = [DynamixelDecoder() for _ in self._bus_ends]
        # Of a second servo with the id of one.
        self._second_servo_delays = [FACTORY_DELAY] * len(self.servos)
        for i in range(len(self.servos)):
            self.restart(i)

    @staticmethod
    def _write_factory_settings(servo: EmulatedDynamixelServo, id_: int, baud: int) -> None:
        """Set the registers that a servo keeps without power."""
        servo.table[FIRMWARE_VERSION] = FIRMWARE
        servo.table[ID] = id_
        servo.table[registers.BAUD_RATE] = registers.RATE[baud]
        servo.table[registers.DELAY] = FACTORY_DELAY
        servo.table[registers.OPERATING_MODE] = 3  # position
        servo.table[registers.SECONDARY_ID] = ID_WITHOUT_SERVO
        servo.table[PROTOCOL] = 2
        servo.table[MAX_TEMPERATURE] = 80  # °C
        servo.write_register("H", PWM_LIMIT, MAX_PWM)
        servo.write_register("H", registers.CURRENT_LIMIT, MAX_CURRENT)
        servo.table[SHUTDOWN] = SHUTDOWN_ERRORS

    def __call__(self) -> None:
        # May wait for the kernel, so it comes before the lock.
        received = [port.receive() for port in self._bus_ends]
        with self.body.lock:
            self.catch_up()
            for port, decoder, data in zip(self._bus_ends, self._decoders, received, strict=True):
                for packet in decoder.feed(data):
                    if packet.instruction != DynamixelInstruction.STATUS:
                        self._handle_packet(port, packet)
            self.simulate_to_now()

    # --- packets ----------------------------------------------------------------------------------------------

    def _handle_packet(self, port: PseudoTerminal, packet: DynamixelPacket) -> None:
        """Handle a packet for one servo or for several servos of a port."""
        listening_servos = [
            i
            for i, servo in enumerate(self.servos)
            if servo.port is port and not self.body.is_booting(i)
        ]
        index_by_id = {self.servos[i].id: i for i in listening_servos}
        for i in listening_servos:
            self.servos[i].last_packet_us = self.body.now_us
        parameters = packet.parameters
        match packet.instruction:
            case DynamixelInstruction.SYNC_WRITE:
                self._execute_sync_write(parameters, index_by_id)
            case DynamixelInstruction.SYNC_READ | DynamixelInstruction.FAST_SYNC_READ:
                indices = [index_by_id.get(id_) for id_ in parameters[4:]]
                self._execute_sync_read(port, packet.instruction, parameters[:4], indices)
            case DynamixelInstruction.PING if packet.id == BROADCAST_ID:
                for _, i in sorted(index_by_id.items()):
                    self._execute_instruction(i, packet.instruction, parameters)
            case instruction if packet.id in index_by_id:
                self._execute_instruction(index_by_id[packet.id], instruction, parameters)
            case _:
                pass

    def _execute_instruction(self, i: int, instruction: int, parameters: bytes) -> None:
        """Execute an instruction for one servo, and send its status.

        Args:
            i: Index of the servo.
            instruction: Instruction of the packet.
            parameters: Parameters of the packet.
        """
        servo = self.servos[i]
        match instruction:
            case DynamixelInstruction.PING:
                self._send_status(
                    i, bytes(servo.table[:2]) + bytes([servo.table[FIRMWARE_VERSION]])
                )
            case DynamixelInstruction.READ:
                data, refusal = self._read_registers(i, parameters)
                self._send_status(i, data, refusal, self._read_second_servo(i, parameters))
            case DynamixelInstruction.WRITE:
                (address,) = struct.unpack_from("<H", parameters)
                refusal = self._write_registers(i, address, parameters[2:])
                self._send_status(i, b"", refusal)
            case DynamixelInstruction.REBOOT:
                self._send_status(i, b"")
                self.body.start_boot(i)
                self.restart(i)
            case _:
                self._send_status(i, b"", DynamixelErrorCode.INSTRUCTION)

    def _execute_sync_write(self, parameters: bytes, index_by_id: Mapping[int, int]) -> None:
        """Execute a sync write: address, size, and an id with data for each servo."""
        address, size = struct.unpack_from("<HH", parameters)
        for start in range(4, len(parameters), size + 1):
            i = index_by_id.get(parameters[start])
            if i is not None:
                self._write_registers(i, address, parameters[start + 1 : start + 1 + size])

    def _execute_sync_read(
        self,
        port: PseudoTerminal,
        instruction: int,
        register_range: bytes,
        indices: Sequence[int | None],
    ) -> None:
        """Send the responses to a sync read, in the order of the ids in the packet.

        Each servo waits for the one before it without a timeout, so the first silent servo ends the response.

        Args:
            port: Pseudo terminal of the servos.
            instruction: SYNC_READ, for one status of each servo, or FAST_SYNC_READ, for one common status.
            register_range: Address and size of the registers, as bytes of the packet.
            indices: Index of the servo of each id in the packet; None for an id that no servo has.
        """
        parts: list[tuple[int, int, bytes]] = []  # error, id and data of each servo
        # The same, with the data of a second servo with its id.
        second_parts: list[tuple[int, int, bytes]] = []
        for i in indices:
            if i is None or self.body.is_silent(i):
                break
            data, refusal = self._read_registers(i, register_range)
            second_data = self._read_second_servo(i, register_range)
            if instruction == DynamixelInstruction.SYNC_READ:
                self._send_status(i, data, refusal, second_data)
            else:
                error = refusal | self._get_alert_bit(i)
                parts.append((error, self.servos[i].id, data))
                second_parts.append((error, self.servos[i].id, second_data))
        if parts:
            port.send(
                simulate_collision(
                    encode_fast_status(parts, len(indices)),
                    encode_fast_status(second_parts, len(indices)),
                )
            )

    def _send_status(
        self, i: int, data: bytes, refusal: int = 0, second_data: bytes | None = None
    ) -> None:
        """Send a servo's status. second_data: the data of a second servo with its id, where they differ."""
        if self.body.is_silent(i):
            return
        servo = self.servos[i]
        error = bytes([refusal | self._get_alert_bit(i)])
        status = encode_packet(servo.id, DynamixelInstruction.STATUS, error + data)
        if not self.body.is_duplicated(i):
            servo.port.send(status)
            return
        if second_data is None:
            second_data = data
        second_status = encode_packet(servo.id, DynamixelInstruction.STATUS, error + second_data)
        if servo.table[registers.DELAY] == self._second_servo_delays[i]:
            servo.port.send(simulate_collision(status, second_status))
        else:
            servo.port.send(status + second_status)

    def _get_alert_bit(self, i: int) -> int:
        """Return the bit of a status that reports a hardware error."""
        if self.servos[i].table[registers.HARDWARE_ERROR]:
            return ALERT
        return 0

    def _read_registers(self, i: int, register_range: bytes) -> tuple[bytes, int]:
        """Return the data of registers, and the refusal, 0 for none. registers: address and size."""
        address, size = struct.unpack("<HH", register_range)
        if address + size > registers.SIZE:
            return b"", DynamixelErrorCode.ACCESS
        self._update_measurements(i)
        return bytes(self.servos[i].table[address : address + size]), 0

    def _read_second_servo(self, i: int, register_range: bytes) -> bytes:
        """Return the same registers of a second servo with the id of this one; without one, of the servo itself."""
        address, size = struct.unpack("<HH", register_range)
        table = self.servos[i].table[:]
        if self.body.is_duplicated(i):
            (counts,) = struct.unpack_from("<i", table, registers.PRESENT_POSITION)
            struct.pack_into("<i", table, registers.PRESENT_POSITION, counts + SECOND_SERVO_COUNTS)
        return bytes(table[address : address + size])

    def _update_measurements(self, i: int) -> None:
        """Update the registers of what a servo measures."""
        servo = self.servos[i]
        angle_rad, velocity_rad_s, torque_nm = self.body.read_shaft(i)
        voltage_v = self.body.read_supply(i)[0]
        temperature_c = self.body.read_temperatures(i)[0]
        current = max(min(round(torque_nm / servo.torque_unit_nm), 32767), -32768)
        servo.write_register("h", registers.PRESENT, current)
        servo.write_register(
            "i", registers.PRESENT_VELOCITY, round(velocity_rad_s / registers.SPEED)
        )
        servo.write_register(
            "i",
            registers.PRESENT_POSITION,
            round(angle_rad / registers.RAD) - servo.turn_offset_counts,
        )
        servo.write_register("H", registers.VOLTAGE, round(voltage_v / registers.VOLTS))
        servo.table[registers.TEMPERATURE] = min(max(round(temperature_c), 0), 255)

    def _write_registers(self, i: int, address: int, data: bytes) -> int:
        """Set consecutive registers, all of them or none, and let the new values take effect.

        Args:
            i: Index of the servo.
            address: Address of the first register.
            data: New values of the registers.

        Returns:
            The reason for a refusal; 0 if the registers were set.
        """
        servo = self.servos[i]
        end = address + len(data)
        if not any(first <= address and end <= last for first, last in WRITABLE):
            return DynamixelErrorCode.ACCESS
        if address < registers.TORQUE_ENABLE and servo.is_torque_on:
            return DynamixelErrorCode.ACCESS
        table = servo.table[:]
        table[address:end] = data
        refusal = self._find_write_refusal(servo, table, address, end)
        if refusal:
            return refusal
        servo.table = table
        if address <= registers.DELAY < end and self.body.is_duplicated(i):
            self._second_servo_delays[i] = table[registers.DELAY]
        if address <= registers.WATCHDOG < end and table[registers.WATCHDOG] == 0:
            servo.hold_position_counts = None
        self._drive_motor(i)
        return 0

    @staticmethod
    def _find_write_refusal(
        servo: EmulatedDynamixelServo, table: bytearray, address: int, end: int
    ) -> int:
        """Return the refusal of a write, 0 for none. table: the control table after it; address, end: what it sets."""
        after = EmulatedDynamixelServo(table, servo.port, servo.torque_unit_nm)
        sets_watchdog = address <= registers.WATCHDOG < end
        sets_goals = address < registers.GOAL_POSITION + 4 and end > FIRST_GOAL
        if servo.table[registers.WATCHDOG] == registers.TRIPPED and sets_goals:
            return DynamixelErrorCode.RANGE
        if table[registers.OPERATING_MODE] not in OPERATING_MODES or (
            sets_watchdog and table[registers.WATCHDOG] > 127
        ):
            return DynamixelErrorCode.RANGE
        if table[registers.TORQUE_ENABLE] > 1 or table[registers.DELAY] > 254:
            return DynamixelErrorCode.RANGE
        if sets_goals and abs(after.read_register("h", registers.GOALS)) > after.read_register(
            "H", registers.CURRENT_LIMIT
        ):
            return DynamixelErrorCode.LIMIT
        if (
            table[registers.TORQUE_ENABLE]
            and servo.table[registers.HARDWARE_ERROR] & servo.table[SHUTDOWN]
        ):
            return DynamixelErrorCode.FAILED
        return 0

    # --- motors -----------------------------------------------------------------------------------------------

    def restart(self, i: int) -> None:
        """Reset all registers from address 64 on, and forget whole revolutions."""
        servo = self.servos[i]
        servo.table[registers.TORQUE_ENABLE :] = bytes(registers.SIZE - registers.TORQUE_ENABLE)
        servo.table[registers.STATUS_LEVEL] = 2
        servo.hold_position_counts = None
        servo.write_register("H", registers.P_GAIN, 800)
        servo.write_register(
            "h", registers.GOALS, servo.read_register("H", registers.CURRENT_LIMIT)
        )
        counts = round(self.body.read_shaft(i)[0] / registers.RAD)
        servo.turn_offset_counts = counts // registers.COUNTS * registers.COUNTS
        self._update_measurements(i)
        servo.write_register(
            "i", registers.GOAL_POSITION, servo.read_register("i", registers.PRESENT_POSITION)
        )
        self._drive_motor(i)

    def _drive_motor(self, i: int) -> None:
        """Apply operating mode, gains and goals in the control table of a servo to its motor.

        The motor is passive unless the torque is on in current-based position mode or in current mode.

        Args:
            i: Index of the servo.
        """
        servo = self.servos[i]
        # The goal current is the setpoint in current mode, and the torque limit in current-based position mode.
        current = servo.read_register("h", registers.GOALS)
        limit_nm = abs(current) * servo.torque_unit_nm
        joint = self.body.joints[i]
        speed_rad_s = joint.limits.speed_rad_s * joint.drive.gear  # without a load
        mode = servo.table[registers.OPERATING_MODE]
        if servo.is_torque_on and mode == registers.CURRENT_BASED_POSITION:
            d_gain = servo.read_register("H", registers.GAINS)
            p_gain = servo.read_register("H", registers.P_GAIN)
            stiffness, damping = registers.compute_position_law(
                d_gain, p_gain, servo.torque_unit_nm
            )
            goal_counts = servo.hold_position_counts
            if goal_counts is None:
                goal_counts = (
                    servo.read_register("i", registers.GOAL_POSITION) + servo.turn_offset_counts
                )
            self.body.drive_motor(
                i,
                JointMode.POSITION,
                goal_counts * registers.RAD,
                limit_nm,
                stiffness,
                damping,
                speed_rad_s,
            )
        elif servo.is_torque_on and mode == registers.CURRENT_CONTROL:
            self.body.drive_motor(
                i, JointMode.TORQUE, current * servo.torque_unit_nm, limit_nm, 0.0, 0.0, speed_rad_s
            )
        else:
            self.body.drive_motor(i, JointMode.PASSIVE, 0.0, 0.0, 0.0, 0.0, speed_rad_s)

    def list_enabled(self) -> list[bool]:
        return [
            servo.is_torque_on and servo.table[registers.WATCHDOG] != registers.TRIPPED
            for servo in self.servos
        ]

    def on_step(self, now_us: float) -> None:
        """Let watchdogs expire, and detect servos that are too hot or have too little supply voltage."""
        for i, servo in enumerate(self.servos):
            watchdog = servo.table[registers.WATCHDOG]
            if (
                servo.is_torque_on
                and 0 < watchdog != registers.TRIPPED
                and now_us - servo.last_packet_us > watchdog * registers.WATCHDOG_S * 1e6
            ):
                servo.table[registers.WATCHDOG] = registers.TRIPPED
                servo.hold_position_counts = round(self.body.read_shaft(i)[0] / registers.RAD)
                self._drive_motor(i)
            errors = self._detect_errors(i)
            if errors & ~servo.table[registers.HARDWARE_ERROR]:
                servo.table[registers.HARDWARE_ERROR] |= errors
                if errors & SHUTDOWN_ERRORS:
                    servo.table[registers.TORQUE_ENABLE] = 0
                    self._drive_motor(i)

    def _detect_errors(self, i: int) -> int:
        """Return the bits of the hardware errors that a servo has now."""
        errors = 0
        if self.body.is_too_hot(i):
            errors |= registers.HardwareError.OVERHEATING
        min_voltage_v = self.servos[i].read_register("H", registers.MIN_VOLTAGE) * registers.VOLTS
        if self.body.read_supply(i)[0] < min_voltage_v:
            errors |= registers.HardwareError.INPUT_VOLTAGE
        return errors


def simulate_collision(first: bytes, second: bytes) -> bytes:
    """Return what two servos that send at the same time leave on the line: a 0 of either wins."""
    longest = max(len(first), len(second))
    first = first.ljust(longest, b"\xff")
    second = second.ljust(longest, b"\xff")
    return bytes(a & b for a, b in zip(first, second, strict=True))
