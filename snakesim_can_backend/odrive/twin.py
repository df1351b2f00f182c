"""Emulated ODrive axes: the messages, states, limits and watchdog of CANSimple, on a body that a plant moves.

They do *not* simulate calibration, encoders that slip, the velocity integrator, trajectories, arbitration and bit rate.
"""

import math
from dataclasses import dataclass
from typing import Any

from snakesim_can_backend.family.twin import CanTwin
from snakesim_can_backend.odrive.axes import TURN, TWIN_CONSTANT
from snakesim_can_backend.odrive.protocol import PAYLOADS, Control, Error, Message, State, ask, parted, write
from snakesim_can_backend.protocol.definitions import Frame
from snakesim_hal.drivers.twin_body import TwinBody
from snakesim_hal.wire.messages import Mode

HEARTBEAT_US = 100_000.0
COUNTS = 16384  # of the encoder, a turn
VERSION = (2, 4, 4, 58, 0, 6, 11, 0)
FIRST_SERIAL = 0x3855_0000_0001
OTHER_SERIAL = 0x0000_0100_0000  # the difference of a second axis with the same id
MODES = {Control.TORQUE: Mode.TORQUE, Control.VELOCITY: Mode.VELOCITY, Control.POSITION: Mode.POSITION}


@dataclass
class Axis:
    """One axis: settings, inputs, state."""

    node: int
    torque_constant: float
    state: int = State.IDLE
    errors: int = 0
    disarm_reason: int = 0
    control: int = Control.POSITION
    inputs: tuple[float, ...] = (0.0, 0.0, 0.0)  # by `Control`, from torque on: N·m, turns/s, turns
    position_gain: float = 20.0
    velocity_gain: float = 0.16
    speed_limit: float = 2.0
    current_limit: float = 10.0
    fed_us: float = 0.0


class OdriveTwin(CanTwin):
    """All axes of a family."""

    def __init__(self, _everybody: object, settings: Any, body: TwinBody, *ends: Any) -> None:
        super().__init__(settings, body, *ends)
        constants = [joint.motor.torque_constant_nm_per_a or TWIN_CONSTANT for joint in body.joints]
        self.axes = [Axis(joint.id, constant) for joint, constant in zip(body.joints, constants, strict=True)]
        self._heartbeat_us = -math.inf
        self.each_step(0.0)

    def addressee(self, frame: Frame) -> int:
        """Its node."""
        return parted(frame)[0]

    def of_second(self, frame: Frame) -> Frame:
        """Its own serial number in the address."""
        if parted(frame)[1] != Message.ADDRESS or not frame.data:
            return frame
        node, serial, connection = PAYLOADS[Message.ADDRESS].unpack(frame.data)
        other = int.from_bytes(serial, "little") ^ OTHER_SERIAL
        return write(node, Message.ADDRESS, node, other.to_bytes(6, "little"), connection)

    def restart(self, i: int) -> None:
        """Settings are lost."""
        self.axes[i] = Axis(self.axes[i].node, self.axes[i].torque_constant)
        self._drive(i, self.axes[i])

    def take(self, i: int, frame: Frame) -> None:
        """Questions have no data."""
        known, axis = Message(parted(frame)[1]), self.axes[i]
        values = PAYLOADS[known].unpack(frame.data) if frame.data else ()
        if not values and known not in (Message.ESTOP, Message.CLEAR_ERRORS):
            self.say(i, self._message(i, axis, known))
        else:
            self._obey(i, axis, known, values)

    def _obey(self, i: int, axis: Axis, message: Message, values: tuple[float, ...]) -> None:
        match message:
            case Message.ESTOP:
                self._fail(i, axis, Error.ESTOP_REQUESTED)
            case Message.CLEAR_ERRORS:
                axis.errors = 0
            case Message.SET_STATE if values[0] == State.CLOSED_LOOP and not axis.errors:
                axis.fed_us = self.body.now_us
                axis.state = State.CLOSED_LOOP
            case Message.SET_STATE:
                axis.state = State.IDLE
            case Message.SET_MODE:
                axis.control = int(values[0])
            case Message.SET_POSITION | Message.SET_VELOCITY | Message.SET_TORQUE:
                axis.fed_us = self.body.now_us
                at = {Message.SET_TORQUE: 0, Message.SET_VELOCITY: 1, Message.SET_POSITION: 2}[message]
                axis.inputs = (*axis.inputs[:at], values[0], *axis.inputs[at + 1 :])
            case Message.SET_LIMITS:
                axis.speed_limit, axis.current_limit = values
            case Message.SET_POSITION_GAIN:
                axis.position_gain = values[0]
            case Message.SET_VELOCITY_GAINS:
                axis.velocity_gain = values[0]
            case _:
                return
        self._drive(i, axis)

    def _message(self, i: int, axis: Axis, message: Message) -> Frame:
        angle, velocity, torque = self.body.shaft(i)
        values: tuple[Any, ...]
        match message:
            case Message.VERSION:
                values = VERSION
            case Message.ADDRESS:
                values = axis.node, (FIRST_SERIAL + i).to_bytes(6, "little"), 0
            case Message.HEARTBEAT:
                values = axis.errors, axis.state, 0, 0
            case Message.ERROR:
                values = axis.errors, axis.disarm_reason
            case Message.MOTION:
                values = round(angle / TURN * COUNTS) / COUNTS, velocity / TURN
            case Message.CURRENT:
                values = torque / axis.torque_constant, torque / axis.torque_constant
            case Message.TEMPERATURE:
                motor_c, board_c = self.body.temperatures(i)
                values = board_c, motor_c
            case Message.SUPPLY:
                values = self.body.supply(i)
            case _:
                return ask(axis.node, message)
        return write(axis.node, message, *values)

    def _drive(self, i: int, axis: Axis) -> None:
        control = Control(axis.control) if axis.control in list(Control) else Control.TORQUE
        mode = MODES[control] if axis.state == State.CLOSED_LOOP else Mode.PASSIVE
        target = axis.inputs[control - 1] * (1.0 if control == Control.TORQUE else TURN)
        damping = axis.velocity_gain / TURN
        limit_nm = axis.current_limit * axis.torque_constant
        speed_rad_s = axis.speed_limit * TURN
        self.body.drive(i, mode, target if mode else 0.0, limit_nm, axis.position_gain * damping, damping, speed_rad_s)

    def _fail(self, i: int, axis: Axis, error: Error) -> None:
        axis.errors |= error
        axis.disarm_reason, axis.state = error, State.IDLE
        self._drive(i, axis)

    def each_step(self, now_us: float) -> None:
        """Watchdogs, heat, heartbeats."""
        for i, axis in enumerate(self.axes):
            if axis.state == State.CLOSED_LOOP and now_us - axis.fed_us > self.watchdog_us:
                self._fail(i, axis, Error.WATCHDOG_TIMER_EXPIRED)
        if now_us - self._heartbeat_us < HEARTBEAT_US:
            return
        self._heartbeat_us = now_us
        for i, axis in enumerate(self.axes):
            if self.body.too_hot(i):
                self._fail(i, axis, Error.MOTOR_OVER_TEMP)
            self.say(i, self._message(i, axis, Message.HEARTBEAT))
