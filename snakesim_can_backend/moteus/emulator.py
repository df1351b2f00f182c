"""Emulated moteus controllers: registers, modes, limits and watchdog, on a body that a physics model moves.

They do *not* simulate the integrator, trajectories, targets that move (a velocity beside a proportional gain),
feed-forward beside gains, position limits, the time that a start takes, arbitration and bit rates.
"""

import math
from dataclasses import dataclass, field

from snakesim_can_backend.can_drives.emulator import CanEmulator, CanEmulatorContext
from snakesim_can_backend.moteus.controllers import (
    REVOLUTION_RAD,
    SERIAL_WORDS,
    get_configured_gains,
)
from snakesim_can_backend.moteus.protocol import (
    BROADCAST_ID,
    FLOAT,
    REGISTER_MAP,
    REPLY,
    REPLY_REQUESTED_BIT,
    VALUE_FORMATS,
    WRITE,
    MoteusMode,
    Register,
    Subframe,
    decode_subframes,
    encode_subframe,
    make_frame,
    split_addresses,
)
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_hal.wire.messages import JointMode

OVER_TEMPERATURE = 38  # fault number
UPPER_SERIAL_WORDS = (0x65115510, 0x30333636)  # the same for all controllers
# In which the serial number of a second controller with the same id differs.
DUPLICATE_SERIAL_BITS = 0x01_0000
HOME_STATE_ROTOR = 1  # home state: the position has a reference within a turn of the rotor
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
INTEGER_RESOLUTIONS = {  # the unit of integers of 8, 16 and 32 bits; 1 for all other registers
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
    watchdog_fed_us: float = 0.0  # when the watchdog was fed


class EmulatedMoteus(CanEmulator):
    """All controllers of a driver type."""

    broadcast_id = BROADCAST_ID

    def __init__(self, context: CanEmulatorContext) -> None:
        """Create one emulated, stopped controller for each joint."""
        super().__init__(context)
        self.controllers = [EmulatedController(joint.id) for joint in context.body.joints]
        self._kp_nm_per_turn, self._kd_nm_s_per_turn = get_configured_gains(
            context.joints, context.settings
        )

    def find_destination_node(self, frame: CanFrame) -> int:
        """Return the destination of a frame."""
        _, destination = split_addresses(frame)
        return destination

    def duplicate_frame(self, frame: CanFrame) -> CanFrame:
        """Return the frame of a second controller: it has another serial number."""
        response_subframes: list[bytes] = []
        for subframe in decode_subframes(frame.data):
            values = list(subframe.values)
            if subframe.register == Register.SERIAL:
                values[0] = int(values[0]) ^ DUPLICATE_SERIAL_BITS
            response_subframes.append(
                encode_subframe(subframe.kind, subframe.type, subframe.register, *values)
            )
        return make_frame(*split_addresses(frame), *response_subframes)

    def restart(self, i: int) -> None:
        """Restart a controller. It is stopped, and has no command."""
        self.controllers[i] = EmulatedController(self.controllers[i].id)
        self._drive_motor(i)

    def handle_frame(self, i: int, frame: CanFrame) -> None:
        """Apply all values that a frame writes together; then send what it reads, if it requests a reply."""
        subframes = list(decode_subframes(frame.data))
        written_values: dict[int, float] = {}
        for subframe in subframes:
            if subframe.kind == WRITE:
                for offset, value in enumerate(subframe.values):
                    written_values[subframe.register + offset] = value
        if Register.MODE in written_values:
            mode = int(written_values.pop(Register.MODE))
            self._change_mode(i, mode, written_values)
        if frame.id & REPLY_REQUESTED_BIT:
            response_subframes = [
                self._read_registers(i, subframe)
                for subframe in subframes
                if subframe.kind not in (WRITE, REPLY)
            ]
            source, _ = split_addresses(frame)
            self.send_frame(i, make_frame(self.controllers[i].id, source, *response_subframes))

    def list_enabled(self) -> list[bool]:
        return [controller.mode == MoteusMode.POSITION for controller in self.controllers]

    def on_step(self, now_us: float) -> None:
        """Stop controllers whose watchdog has expired, and those that are too hot."""
        for i, controller in enumerate(self.controllers):
            if controller.mode == MoteusMode.POSITION:
                watchdog_timeout_us = (
                    controller.command[Register.WATCHDOG] * 1e6 or self.watchdog_us
                )
                # Never true if the limit is NaN.
                if now_us - controller.watchdog_fed_us > watchdog_timeout_us:
                    controller.mode = MoteusMode.TIMEOUT
                    self._drive_motor(i)
            if self.body.is_too_hot(i) and controller.mode != MoteusMode.FAULT:
                controller.mode = MoteusMode.FAULT
                controller.fault = OVER_TEMPERATURE
                self._drive_motor(i)

    # --- inside -----------------------------------------------------------------------------------------------

    def _change_mode(self, i: int, mode: int, written_values: dict[int, float]) -> None:
        """Change the mode of a controller. A controller that has stopped by itself accepts only a stop.

        Args:
            i: Index of the controller.
            mode: Requested mode; modes other than STOPPED and POSITION are ignored.
            written_values: Values of the other registers that the frame writes, by register.
        """
        controller = self.controllers[i]
        can_start = controller.mode in (MoteusMode.STOPPED, MoteusMode.POSITION)
        match mode:
            case MoteusMode.STOPPED:
                controller.mode = MoteusMode.STOPPED
                controller.fault = 0
            case MoteusMode.POSITION if can_start:
                controller.mode = MoteusMode.POSITION
                controller.watchdog_fed_us = self.body.now_us
                controller.command = COMMAND_DEFAULTS | written_values
            case _:
                pass
        self._drive_motor(i)

    def _read_registers(self, i: int, request: Subframe) -> bytes:
        """Return a reply subframe with the requested registers in the requested type, clipped to its range."""
        values: list[float] = []
        for register in range(request.register, request.register + request.length):
            value = self._read_register(i, register)
            if request.type != FLOAT:
                resolution = (
                    INTEGER_RESOLUTIONS[Register(register)][request.type]
                    if register in INTEGER_RESOLUTIONS
                    else 1.0
                )
                max_integer = (1 << 8 * VALUE_FORMATS[request.type].size - 1) - 1
                value = min(max(round(value / resolution), -max_integer), max_integer)
            values.append(value)
        return encode_subframe(REPLY, request.type, request.register, *values)

    def _read_register(self, i: int, register: int) -> float:
        """Return the value that an emulated controller has in a register, in the units of moteus.

        Args:
            i: Index of the controller.
            register: Number of the register.
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
            case (
                Register.POWER
                | Register.VOLTAGE
                | Register.MOTOR_TEMPERATURE
                | Register.BOARD_TEMPERATURE
            ):
                return self._read_health_register(i, register)
            case Register.FAULT:
                return controller.fault
            case Register.MAP_VERSION:
                return REGISTER_MAP
            case Register.COMMAND | Register.WATCHDOG:
                return 0
            case _:  # the home state; registers that are not emulated have the same value
                return HOME_STATE_ROTOR

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

        A command with a proportional gain is position control, one with only a derivative gain is velocity control, and
        one without gains is torque control. The motor is passive unless the controller is in position mode.

        Args:
            i: Index of the controller.
        """
        controller = self.controllers[i]
        joint = self.body.joints[i]
        position, velocity, torque, kp, kd, limit_nm = (
            controller.command[FIRST_COMMAND_REGISTER + offset] for offset in range(6)
        )
        if controller.mode != MoteusMode.POSITION:
            mode = JointMode.PASSIVE
            target = 0.0
        elif kp:
            mode = JointMode.POSITION
            target = (
                self.body.read_shaft(i)[0] if math.isnan(position) else position * REVOLUTION_RAD
            )
        elif kd:
            mode = JointMode.VELOCITY
            target = velocity * REVOLUTION_RAD
        else:
            mode = JointMode.TORQUE
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
