"""Emulated servos: control table, packets, errors and restarts of the STS series, on a body that moves.

They have no watchdog, as the real ones. They do *not* simulate bit rate and delays of answers, speed and acceleration,
the overload protection, encoder faults, and the position law's gains: a motor has the stiffness and the damping of the
robot file. A goal switches the torque on, which real servos may do.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from snakesim_drivers.emulation.emulated_body import EmulatedBody
from snakesim_hal.wire.messages import JointMode
from snakesim_serial_backend.feetech import registers
from snakesim_serial_backend.feetech.packets import (
    BROADCAST_ID,
    OFFSET_SIGN_BIT,
    SIGN_BIT,
    FeetechDecoder,
    FeetechInstruction,
    FeetechPacket,
    ServoError,
    decode_sign_magnitude,
    encode_packet,
    encode_sign_magnitude,
)
from snakesim_serial_backend.servo_backend import ServoEmulator
from snakesim_serial_backend.wire import PseudoTerminal

MODEL = 777  # STS3215
FIRMWARE = (3, 10)
FACTORY_DELAY = 250  # of an answer, in 2 us
FACTORY_UNLOADING = 44  # overload, overcurrent, overheating
SECOND_SERVO_COUNTS = 500  # how far from a servo a second one with its id is


@dataclass
class EmulatedFeetechServo:
    """One servo: its control table, and what the table does not hold."""

    table: bytearray
    port: PseudoTerminal
    stall_torque_nm: float

    def read_word(self, address: int) -> int:
        """Return a register of 2 bytes."""
        return int.from_bytes(self.table[address : address + 2], "little")

    def write_word(self, address: int, value: int) -> None:
        """Set a register of 2 bytes."""
        self.table[address : address + 2] = value.to_bytes(2, "little")

    @property
    def id(self) -> int:
        """The id to which the servo answers."""
        return self.table[registers.ID]

    @property
    def is_torque_on(self) -> bool:
        """Whether the torque is on."""
        return self.table[registers.TORQUE_ENABLE] == 1


class EmulatedFeetech(ServoEmulator):
    """All servos of a robot, at the other end of their ports."""

    def __init__(
        self,
        body: EmulatedBody,
        ports: Sequence[PseudoTerminal],
        stall_torques_nm: Sequence[float],
        baud: int,
        speed_unit_counts_s: float,
        clock_ns: Callable[[], int],
    ) -> None:
        """Create an emulated servo for every joint of a body.

        Args:
            body: Body that the servos move.
            ports: Pseudo terminal of every joint's servo; servos of one port have the same object.
            stall_torques_nm: Stall torque of every joint's servo.
            baud: Baud rate that the servos are set to, in bit/s.
            speed_unit_counts_s: Counts per second in a unit of the speed registers.
            clock_ns: Function that returns a steady time in ns, with any origin.
        """
        self._speed_unit_rad_s = speed_unit_counts_s * registers.RAD
        self.servos: list[EmulatedFeetechServo] = []
        for joint, port, stall_torque_nm in zip(body.joints, ports, stall_torques_nm, strict=True):
            servo = EmulatedFeetechServo(bytearray(registers.SIZE), port, stall_torque_nm)
            _write_factory_settings(servo, joint.id, baud)
            servo.table[registers.MIN_VOLTAGE] = round(joint.limits.min_voltage_v / registers.VOLTS)
            servo.table[registers.MAX_VOLTAGE] = min(
                round(joint.supply.voltage_v / registers.VOLTS) + 20, 255
            )
            self.servos.append(servo)
        super().__init__(body, ports, clock_ns)
        self._decoders = [FeetechDecoder() for _ in self._bus_ends]
        # Of a second servo with the id of one.
        self._second_servo_delays = [FACTORY_DELAY] * len(self.servos)
        for i in range(len(self.servos)):
            self.restart(i)

    def __call__(self) -> None:
        # May wait for the kernel, so it comes before the lock.
        received = [port.receive() for port in self._bus_ends]
        with self.body.lock:
            self.catch_up()
            for port, decoder, data in zip(self._bus_ends, self._decoders, received, strict=True):
                for packet in decoder.feed(data):
                    self._handle_packet(port, packet)
            self.simulate_to_now()

    # --- packets ----------------------------------------------------------------------------------------------

    def _handle_packet(self, port: PseudoTerminal, packet: FeetechPacket) -> None:
        """Handle a packet for one servo or for several servos of a port."""
        listening_servos = [
            i
            for i, servo in enumerate(self.servos)
            if servo.port is port and not self.body.is_booting(i)
        ]
        index_by_id = {self.servos[i].id: i for i in listening_servos}
        match packet.code:
            case FeetechInstruction.SYNC_WRITE:
                self._execute_sync_write(packet.parameters, index_by_id)
            case FeetechInstruction.SYNC_READ:
                self._execute_sync_read(packet.parameters, index_by_id)
            case FeetechInstruction.PING if packet.id == BROADCAST_ID:
                for _, i in sorted(index_by_id.items()):
                    self._send_status(i, b"")
            case _ if packet.id in index_by_id:
                self._execute_instruction(index_by_id[packet.id], packet)
            case _:
                pass

    def _execute_instruction(self, i: int, packet: FeetechPacket) -> None:
        """Execute an instruction to one servo, and answer it."""
        match packet.code:
            case FeetechInstruction.PING:
                self._send_status(i, b"")
            case FeetechInstruction.READ:
                address, size = packet.parameters
                self._send_status(
                    i,
                    self._read_registers(i, address, size),
                    self._read_second_servo(i, address, size),
                )
            case FeetechInstruction.WRITE:
                self._write_registers(i, packet.parameters[0], packet.parameters[1:])
                if self.servos[i].table[registers.STATUS_LEVEL]:
                    self._send_status(i, b"")
            case _:
                pass

    def _execute_sync_write(self, parameters: bytes, index_by_id: Mapping[int, int]) -> None:
        """Execute a sync write: address, size, and an id with data for each servo."""
        address, size = parameters[:2]
        for start in range(2, len(parameters), size + 1):
            i = index_by_id.get(parameters[start])
            if i is not None:
                self._write_registers(i, address, parameters[start + 1 : start + 1 + size])

    def _execute_sync_read(self, parameters: bytes, index_by_id: Mapping[int, int]) -> None:
        """Answer a sync read in the order of its ids. The first servo that is silent ends the answers."""
        address, size = parameters[:2]
        for id_ in parameters[2:]:
            i = index_by_id.get(id_)
            if i is None or self.body.is_silent(i):
                return
            self._send_status(
                i, self._read_registers(i, address, size), self._read_second_servo(i, address, size)
            )

    def _send_status(self, i: int, data: bytes, second_data: bytes | None = None) -> None:
        """Send a servo's status. second_data: the data of a second servo with its id, where they differ."""
        if self.body.is_silent(i):
            return
        servo = self.servos[i]
        error = servo.table[registers.STATUS]
        status = encode_packet(servo.id, error, data)
        if not self.body.is_duplicated(i):
            servo.port.send(status)
            return
        second_status = encode_packet(servo.id, error, data if second_data is None else second_data)
        if servo.table[registers.DELAY] == self._second_servo_delays[i]:
            # A 0 of either wins.
            servo.port.send(bytes(a & b for a, b in zip(status, second_status, strict=True)))
        else:
            servo.port.send(status + second_status)

    def _read_registers(self, i: int, address: int, size: int) -> bytes:
        """Return the data of registers; 0 beyond the last one."""
        self._update_measurements(i)
        return bytes(self.servos[i].table[address : address + size]).ljust(size, b"\0")

    def _read_second_servo(self, i: int, address: int, size: int) -> bytes:
        """Return the same registers of a second servo with the id of this one."""
        table = self.servos[i].table[:]
        position = int.from_bytes(table[registers.PRESENT : registers.PRESENT + 2], "little")
        second_position = (position + SECOND_SERVO_COUNTS) % registers.COUNTS
        table[registers.PRESENT : registers.PRESENT + 2] = second_position.to_bytes(2, "little")
        return bytes(table[address : address + size]).ljust(size, b"\0")

    def _update_measurements(self, i: int) -> None:
        """Update the registers of what a servo measures."""
        servo = self.servos[i]
        angle_rad, velocity_rad_s, torque_nm = self.body.read_shaft(i)
        voltage_v, current_a = self.body.read_supply(i)
        offset = decode_sign_magnitude(servo.read_word(registers.HOMING_OFFSET), OFFSET_SIGN_BIT)
        position = (round(angle_rad / registers.RAD) + registers.MIDDLE - offset) % registers.COUNTS
        speed = max(min(round(velocity_rad_s / self._speed_unit_rad_s), 32767), -32767)
        load = max(min(round(torque_nm / servo.stall_torque_nm * registers.PER_MILLE), 1023), -1023)
        servo.write_word(registers.PRESENT, position)
        servo.write_word(registers.PRESENT + 2, encode_sign_magnitude(speed, SIGN_BIT))
        servo.write_word(registers.PRESENT + 4, encode_sign_magnitude(load, 10))
        servo.table[registers.VOLTAGE] = min(round(voltage_v / registers.VOLTS), 255)
        servo.table[registers.TEMPERATURE] = min(
            max(round(self.body.read_temperatures(i)[0]), 0), 255
        )
        servo.write_word(registers.CURRENT, min(round(abs(current_a) / registers.CURRENT_A), 32767))

    def _write_registers(self, i: int, address: int, data: bytes) -> None:
        """Set registers, as far as they can be written: a servo does not report a refusal."""
        servo = self.servos[i]
        end = address + len(data)
        if address < registers.ID or end > registers.PRESENT:
            return
        if address < registers.EEPROM_SIZE and (servo.table[registers.LOCK] or servo.is_torque_on):
            return
        servo.table[address:end] = data
        if address <= registers.DELAY < end and self.body.is_duplicated(i):
            self._second_servo_delays[i] = data[registers.DELAY - address]
        if address <= registers.GOALS < end:
            servo.table[registers.TORQUE_ENABLE] = 1
        if servo.table[registers.STATUS] & servo.table[registers.UNLOADING]:
            servo.table[registers.TORQUE_ENABLE] = 0
        self._drive_motor(i)

    # --- motors -----------------------------------------------------------------------------------------------

    def restart(self, i: int) -> None:
        """Reset all registers from address 40 on."""
        servo = self.servos[i]
        servo.table[registers.TORQUE_ENABLE :] = bytes(registers.SIZE - registers.TORQUE_ENABLE)
        servo.write_word(registers.TORQUE_LIMIT, servo.read_word(registers.MAX_TORQUE))
        servo.table[registers.LOCK] = registers.LOCKED
        self._update_measurements(i)
        servo.write_word(registers.GOALS, servo.read_word(registers.PRESENT))
        self._drive_motor(i)

    def _drive_motor(self, i: int) -> None:
        """Apply goal, limits and gains in the control table of a servo to its motor.

        The motor is passive unless the torque is on in position mode.

        Args:
            i: Index of the servo.
        """
        servo = self.servos[i]
        joint = self.body.joints[i]
        speed_rad_s = joint.limits.speed_rad_s * joint.drive.gear  # without a load
        if (
            not servo.is_torque_on
            or servo.table[registers.OPERATING_MODE] != registers.POSITION_MODE
        ):
            self.body.drive_motor(i, JointMode.PASSIVE, 0.0, 0.0, 0.0, 0.0, speed_rad_s)
            return
        # The goal, limited to the servo's own travel, in counts after the homing offset.
        offset = decode_sign_magnitude(servo.read_word(registers.HOMING_OFFSET), OFFSET_SIGN_BIT)
        requested_goal = decode_sign_magnitude(servo.read_word(registers.GOALS), SIGN_BIT)
        min_position = servo.read_word(registers.MIN_POSITION)
        max_position = servo.read_word(registers.MAX_POSITION)
        goal = min(max(requested_goal, min_position), max_position)
        # The torque limit, in thousandths of the stall torque.
        limit_per_mille = min(servo.read_word(registers.TORQUE_LIMIT), registers.PER_MILLE)
        limit_nm = limit_per_mille / registers.PER_MILLE * servo.stall_torque_nm
        # The gains of the joint, at the shaft of the servo.
        stiffness = joint.motor.stiffness_nm_per_rad / joint.drive.gear**2
        damping = joint.motor.damping_nm_s_per_rad / joint.drive.gear**2
        goal_rad = registers.to_angle_rad(goal + offset)
        self.body.drive_motor(
            i, JointMode.POSITION, goal_rad, limit_nm, stiffness, damping, speed_rad_s
        )

    def list_enabled(self) -> list[bool]:
        return [servo.is_torque_on for servo in self.servos]

    def on_step(self, now_us: float) -> None:
        """Detect servos that are too hot or have too little supply voltage."""
        del now_us
        for i, servo in enumerate(self.servos):
            errors = 0
            if self.body.is_too_hot(i):
                errors |= ServoError.OVERHEATING
            if self.body.read_supply(i)[0] < servo.table[registers.MIN_VOLTAGE] * registers.VOLTS:
                errors |= ServoError.VOLTAGE
            servo.table[registers.STATUS] = errors
            if servo.is_torque_on and errors & servo.table[registers.UNLOADING]:
                servo.table[registers.TORQUE_ENABLE] = 0
                self._drive_motor(i)


def _write_factory_settings(servo: EmulatedFeetechServo, id_: int, baud: int) -> None:
    """Set the registers that a servo keeps without power."""
    servo.table[registers.FIRMWARE : registers.FIRMWARE + 2] = bytes(FIRMWARE)
    servo.write_word(registers.MODEL, MODEL)
    servo.table[registers.ID] = id_
    servo.table[registers.BAUD_RATE] = registers.RATE[baud]
    servo.table[registers.DELAY] = FACTORY_DELAY
    servo.table[registers.STATUS_LEVEL] = 1
    servo.write_word(registers.MAX_POSITION, registers.LAST_POSITION)
    servo.table[registers.MAX_TEMPERATURE] = 70  # °C
    servo.write_word(registers.MAX_TORQUE, registers.PER_MILLE)
    servo.table[registers.PHASE] = 12
    servo.table[registers.UNLOADING] = FACTORY_UNLOADING
    servo.table[registers.PROTECTIVE_TORQUE] = 20  # percent
    servo.table[registers.PROTECTION_TIME] = 200
    servo.table[registers.OVERLOAD_TORQUE] = 80  # percent
