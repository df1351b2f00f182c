"""Emulated moteus controllers: registers, modes, limits and watchdog, on a body that a physics model moves.

They do *not* simulate the integrator, trajectories, targets that move (a velocity beside a proportional gain),
feed-forward beside gains, position limits, the time that a start takes, arbitration and bit rates.
"""

import math
from dataclasses import dataclass, field

from snakesim_can_backend.can_drives.emulator import CanEmulator, CanEmulatorContext
from snakesim_can_backend.moteus.controllers import REVOLUTION_RAD, SERIAL_WORDS, configured_gains
from snakesim_can_backend.moteus.protocol import (
    BROADCAST_ID,
    FLOAT,
    REGISTER_MAP,
    REPLY,
    REPLY_REQUESTED,
    TYPES,
    WRITE,
    MoteusMode,
    Register,
    Subframe,
    decode_subframes,
    encode_subframe,
    make_frame,
    split_addresses,
)
from snakesim_can_backend.protocol.definitions import Frame
from snakesim_hal.wire.messages import Mode

OVER_TEMPERATURE = 38  # fault number
UPPER_SERIAL_WORDS = (0x65115510, 0x30333636)  # the same for all controllers
DUPLICATE_SERIAL_BITS = 0x01_0000  # in which the serial number of a second controller with the same id differs
ROTOR = 1  # home state: the position has a reference within a turn of the rotor
FIRST_COMMAND_REGISTER = int(Register.COMMAND)
# Values of the registers that a command does not write.
COMMAND_DEFAULTS = {
    0x20: 0.0,  # position
    0x21: 0.0,  # velocity
    0x22: 0.0,  # feed-forward torque
    0x23: 1.0,  # kp scale
    0x24: 1.0,  # kd scale
    0x25: math.nan,  # maximum torque: the configured one
    0x27: 0.0,  # watchdog: the configured one
}
STEPS = {  # the unit of integers of 8, 16 and 32 bits; 1 for all other registers
    Register.POSITION: (0.01, 0.0001, 0.00001),
    Register.VELOCITY: (0.1, 0.00025, 0.00001),
    Register.TORQUE: (0.5, 0.01, 0.001),
    Register.POWER: (10.0, 0.05, 0.0001),
    Register.MOTOR_TEMPERATURE: (1.0, 0.1, 0.001),
    Register.VOLTAGE: (0.5, 0.1, 0.001),
    Register.BOARD_TEMPERATURE: (1.0, 0.1, 0.001),
}


@dataclass
class EmulatedController:
    """One controller."""

    id: int
    mode: int = MoteusMode.STOPPED
    fault: int = 0
    command: dict[int, float] = field(default_factory=lambda: dict(COMMAND_DEFAULTS))
    command_us: float = 0.0  # when the watchdog was fed


class EmulatedMoteus(CanEmulator):
    """All controllers of a driver type."""

    broadcast_id = BROADCAST_ID

    def __init__(self, context: CanEmulatorContext) -> None:
        """Start all controllers."""
        super().__init__(context)
        self.controllers = [EmulatedController(joint.id) for joint in context.body.joints]
        self._kp_nm_per_turn, self._kd_nm_s_per_turn = configured_gains(context.joints, context.settings)

    def find_addressee(self, frame: Frame) -> int:
        """Return the destination of a frame."""
        _, destination = split_addresses(frame)
        return destination

    def duplicate_frame(self, frame: Frame) -> Frame:
        """Return the frame of a second controller: it has another serial number."""
        answers: list[bytes] = []
        for subframe in decode_subframes(frame.data):
            values = list(subframe.values)
            if subframe.register == Register.SERIAL:
                values[0] = int(values[0]) ^ DUPLICATE_SERIAL_BITS
            answers.append(encode_subframe(subframe.kind, subframe.type, subframe.register, *values))
        return make_frame(*split_addresses(frame), *answers)

    def restart(self, i: int) -> None:
        """Restart a controller. It is stopped, and has no command."""
        self.controllers[i] = EmulatedController(self.controllers[i].id)
        self._drive_motor(i)

    def handle_frame(self, i: int, frame: Frame) -> None:
        """Apply all values that a frame writes together; then answer what it reads, if it wants a reply."""
        subframes = list(decode_subframes(frame.data))
        written: dict[int, float] = {}
        for subframe in subframes:
            if subframe.kind == WRITE:
                for offset, value in enumerate(subframe.values):
                    written[subframe.register + offset] = value
        if Register.MODE in written:
            mode = int(written.pop(Register.MODE))
            self._obey(i, mode, written)
        if frame.id & REPLY_REQUESTED:
            answers = [self._answer(i, subframe) for subframe in subframes if subframe.kind not in (WRITE, REPLY)]
            source, _ = split_addresses(frame)
            self.send_frame(i, make_frame(self.controllers[i].id, source, *answers))

    def on_step(self, now_us: float) -> None:
        """Stop controllers whose watchdog has expired, and those that are too hot."""
        for i, controller in enumerate(self.controllers):
            if controller.mode == MoteusMode.POSITION:
                limit_us = controller.command[Register.WATCHDOG] * 1e6 or self.watchdog_us
                if now_us - controller.command_us > limit_us:  # never true if the limit is NaN
                    controller.mode = MoteusMode.TIMEOUT
                    self._drive_motor(i)
            if self.body.is_too_hot(i) and controller.mode != MoteusMode.FAULT:
                controller.mode = MoteusMode.FAULT
                controller.fault = OVER_TEMPERATURE
                self._drive_motor(i)

    # --- inside -----------------------------------------------------------------------------------------------

    def _obey(self, i: int, mode: int, written: dict[int, float]) -> None:
        """Change the mode. A controller that has stopped by itself obeys a stop only."""
        controller = self.controllers[i]
        can_start = controller.mode in (MoteusMode.STOPPED, MoteusMode.POSITION)
        match mode:
            case MoteusMode.STOPPED:
                controller.mode = MoteusMode.STOPPED
                controller.fault = 0
            case MoteusMode.POSITION if can_start:
                controller.mode = MoteusMode.POSITION
                controller.command_us = self.body.now_us
                controller.command = COMMAND_DEFAULTS | written
            case _:
                pass
        self._drive_motor(i)

    def _answer(self, i: int, request: Subframe) -> bytes:
        """Return the values of registers in the type that the request wants, clipped to its range."""
        values: list[float] = []
        for register in range(request.register, request.register + request.length):
            value = self._read_register(i, register)
            if request.type != FLOAT:
                step = STEPS[Register(register)][request.type] if register in STEPS else 1.0
                max_integer = (1 << 8 * TYPES[request.type].size - 1) - 1
                value = min(max(round(value / step), -max_integer), max_integer)
            values.append(value)
        return encode_subframe(REPLY, request.type, request.register, *values)

    def _read_register(self, i: int, register: int) -> float:
        """Return the value that an emulated controller has in a register, in the units of moteus.

        Args:
            i: index of the controller.
            register: number of the register.
        """
        serial_word = register - Register.SERIAL
        if serial_word in range(SERIAL_WORDS):
            return (i + 1, *UPPER_SERIAL_WORDS)[serial_word]
        controller = self.controllers[i]
        angle_rad, velocity_rad_s, torque_nm = self.body.read_shaft(i)
        match register:
            case Register.MODE:
                return controller.mode
            case Register.POSITION:
                return angle_rad / REVOLUTION_RAD
            case Register.VELOCITY:
                return velocity_rad_s / REVOLUTION_RAD
            case Register.TORQUE:
                return torque_nm
            case Register.POWER | Register.VOLTAGE | Register.MOTOR_TEMPERATURE | Register.BOARD_TEMPERATURE:
                return self._read_health_register(i, register)
            case Register.FAULT:
                return controller.fault
            case Register.MAP_VERSION:
                return REGISTER_MAP
            case Register.COMMAND | Register.WATCHDOG:
                return 0
            case _:  # the home state; registers that are not emulated have the same value
                return ROTOR

    def _read_health_register(self, i: int, register: int) -> float:
        voltage_v, current_a = self.body.read_supply(i)
        motor_c, board_c = self.body.read_temperatures(i)
        match register:
            case Register.POWER:
                return voltage_v * current_a
            case Register.VOLTAGE:
                return voltage_v
            case Register.MOTOR_TEMPERATURE:
                return motor_c
            case _:
                return board_c

    def _drive_motor(self, i: int) -> None:
        """Apply the command of a controller to its motor.

        With a proportional gain this is position control, with a derivative gain alone velocity control, and without
        gains torque control.

        Args:
            i: index of the controller.
        """
        controller = self.controllers[i]
        joint = self.body.joints[i]
        position, velocity, torque, kp, kd, limit_nm = (
            controller.command[FIRST_COMMAND_REGISTER + offset] for offset in range(6)
        )
        if controller.mode != MoteusMode.POSITION:
            mode = Mode.PASSIVE
            target = 0.0
        elif kp:
            mode = Mode.POSITION
            target = self.body.read_shaft(i)[0] if math.isnan(position) else position * REVOLUTION_RAD
        elif kd:
            mode = Mode.VELOCITY
            target = velocity * REVOLUTION_RAD
        else:
            mode = Mode.TORQUE
            target = torque
        if math.isnan(limit_nm):
            limit_nm = joint.limits.torque_nm / joint.drive.gear
        self.body.drive_motor(
            i,
            mode,
            target,
            limit_nm=limit_nm,
            stiffness=kp * self._kp_nm_per_turn / REVOLUTION_RAD,
            damping=kd * self._kd_nm_s_per_turn / REVOLUTION_RAD,
            speed_rad_s=joint.limits.speed_rad_s * joint.drive.gear,
        )
