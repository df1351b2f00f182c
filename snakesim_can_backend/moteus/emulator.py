"""Emulated moteus controllers: registers, modes, limits and watchdog, on a body that a physics model moves.

They do *not* simulate the integrator, trajectories, targets that move (a velocity beside a proportional gain),
feed-forward beside gains, position limits, the time that a start takes, arbitration and bit rates.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from snakesim_can_backend.can_drives.emulator import CanEmulator
from snakesim_can_backend.moteus.controllers import SERIAL_WORDS, TURN, configured_gains
from snakesim_can_backend.moteus.protocol import (
    BROADCAST_ID,
    FLOAT,
    REGISTER_MAP,
    REPLY,
    REPLY_WANTED,
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
from snakesim_drivers.emulation.emulated_body import EmulatedBody
from snakesim_hal.model.joints import Joint
from snakesim_hal.wire.messages import Mode as JointMode

OVER_TEMPERATURE = 38
OTHER_WORDS = 0x65115510, 0x30333636  # of all serial numbers, above the one that counts
OTHER_SERIAL = 0x01_0000  # the difference of a second controller with the same id
ROTOR = 1  # home state
DEFAULTS = {0x20: 0.0, 0x21: 0.0, 0x22: 0.0, 0x23: 1.0, 0x24: 1.0, 0x25: math.nan, 0x27: 0.0}  # of a command
STEPS = {  # an integer's unit, of 8, 16 and 32 bits; of the others 1
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
    command: dict[int, float] = field(default_factory=lambda: dict(DEFAULTS))
    fed_us: float = 0.0


class EmulatedMoteus(CanEmulator):
    """All controllers of a driver type."""

    def __init__(self, everybody: Sequence[Joint], settings: Any, body: EmulatedBody, *ends: Any) -> None:
        super().__init__(settings, body, *ends)
        self.controllers = [EmulatedController(joint.id) for joint in body.joints]
        self._kp, self._kd = configured_gains(everybody, settings)

    everybody = BROADCAST_ID

    def find_addressee(self, frame: Frame) -> int:
        """Its destination."""
        return split_addresses(frame)[1]

    def duplicate_frame(self, frame: Frame) -> Frame:
        """Its own serial number, where the frame has one."""
        answers: list[bytes] = []
        for said in decode_subframes(frame.data):
            values = list(said.values)
            if said.register == Register.SERIAL:
                values[0] = int(values[0]) ^ OTHER_SERIAL
            answers.append(encode_subframe(said.kind, said.type, said.register, *values))
        return make_frame(*split_addresses(frame), *answers)

    def restart(self, i: int) -> None:
        """Stopped, and without a command."""
        self.controllers[i] = EmulatedController(self.controllers[i].id)
        self._drive(i)

    def handle_frame(self, i: int, frame: Frame) -> None:
        """Writes act together; then reads are answered, if the frame asks for it."""
        found = list(decode_subframes(frame.data))
        written = {one.register + k: v for one in found if one.kind == WRITE for k, v in enumerate(one.values)}
        if Register.MODE in written:
            self._obey(i, self.controllers[i], int(written.pop(Register.MODE)), written)
        if frame.id & REPLY_WANTED:
            answers = [self._answer(i, one) for one in found if one.kind not in (WRITE, REPLY)]
            self.say(i, make_frame(self.controllers[i].id, split_addresses(frame)[0], *answers))

    def _obey(self, i: int, controller: EmulatedController, mode: int, written: dict[int, float]) -> None:
        if mode == MoteusMode.STOPPED:
            controller.mode, controller.fault = MoteusMode.STOPPED, 0
        elif mode == MoteusMode.POSITION and controller.mode in (MoteusMode.STOPPED, MoteusMode.POSITION):
            controller.mode, controller.fed_us = MoteusMode.POSITION, self.body.now_us
            controller.command = DEFAULTS | written
        self._drive(i)

    def _answer(self, i: int, asked: Subframe) -> bytes:
        values: list[float] = []
        for register in range(asked.register, asked.register + asked.length):
            value = self._value(i, register)
            if asked.type != FLOAT:
                step = STEPS[Register(register)][asked.type] if register in STEPS else 1.0
                most = (1 << 8 * TYPES[asked.type].size - 1) - 1
                value = min(max(round(value / step), -most), most)
            values.append(value)
        return encode_subframe(REPLY, asked.type, asked.register, *values)

    def _value(self, i: int, register: int) -> float:
        angle, velocity, torque = self.body.read_shaft(i)
        motor_c, board_c = self.body.read_temperatures(i)
        voltage_v, current_a = self.body.read_supply(i)
        if register - Register.SERIAL in range(SERIAL_WORDS):
            return (i + 1, *OTHER_WORDS)[register - Register.SERIAL]
        known = {
            Register.MODE: self.controllers[i].mode,
            Register.POSITION: angle / TURN,
            Register.VELOCITY: velocity / TURN,
            Register.TORQUE: torque,
            Register.POWER: voltage_v * current_a,
            Register.MOTOR_TEMPERATURE: motor_c,
            Register.HOME_STATE: ROTOR,
            Register.VOLTAGE: voltage_v,
            Register.BOARD_TEMPERATURE: board_c,
            Register.FAULT: self.controllers[i].fault,
            Register.MAP_VERSION: REGISTER_MAP,
        }
        return known.get(Register(register) if register in list(Register) else Register.HOME_STATE, 0)

    def _drive(self, i: int) -> None:
        controller, joint = self.controllers[i], self.body.joints[i]
        position, velocity, torque, kp, kd, limit_nm = (controller.command[0x20 + k] for k in range(6))
        stiffness, damping = kp * self._kp / TURN, kd * self._kd / TURN
        if controller.mode != MoteusMode.POSITION:
            mode, target = JointMode.PASSIVE, 0.0
        elif kp:
            here = self.body.read_shaft(i)[0] if math.isnan(position) else position * TURN
            mode, target = JointMode.POSITION, here
        elif kd:
            mode, target = JointMode.VELOCITY, velocity * TURN
        else:
            mode, target = JointMode.TORQUE, torque
        own_nm = joint.limits.torque_nm / joint.drive.gear
        limit_nm = own_nm if math.isnan(limit_nm) else limit_nm
        self.body.drive_motor(
            i, mode, target, limit_nm, stiffness, damping, joint.limits.speed_rad_s * joint.drive.gear
        )

    def on_step(self, now_us: float) -> None:
        """Watchdogs and heat."""
        for i, controller in enumerate(self.controllers):
            if controller.mode == MoteusMode.POSITION:
                limit_us = controller.command[0x27] * 1e6 or self.watchdog_us
                if now_us - controller.fed_us > limit_us:  # never, of NaN
                    controller.mode = MoteusMode.TIMEOUT
                    self._drive(i)
            if self.body.is_too_hot(i) and controller.mode != MoteusMode.FAULT:
                controller.mode, controller.fault = MoteusMode.FAULT, OVER_TEMPERATURE
                self._drive(i)
