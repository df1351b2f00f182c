"""Emulated ODrive axes: the messages, states, limits and watchdog of CANSimple, on a body that a physics model moves.

They do *not* simulate calibration, encoders that slip, the velocity integrator, the speed limit of torque mode, the
error of overspeed, trajectories, arbitration and bit rate.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from snakesim_can_backend.can_drives.emulator import CanEmulator
from snakesim_can_backend.odrive.axes import TURN, TWIN_CONSTANT, needed_current_a
from snakesim_can_backend.odrive.endpoints import EMULATED, FORMATS, TYPES, Setting, read_all_endpoints
from snakesim_can_backend.odrive.protocol import (
    PAYLOADS,
    READ_SETTING,
    SDO_HEAD,
    Control,
    Error,
    Message,
    State,
    ask,
    parted,
    say_setting,
    write,
)
from snakesim_can_backend.protocol.definitions import Frame
from snakesim_drivers.emulation.emulated_body import EmulatedBody
from snakesim_hal.model.joints import Joint
from snakesim_hal.wire.messages import Mode

HEARTBEAT_US = 100_000.0
COUNTS = 16384  # of the encoder, a turn
VERSION = (2, 4, 4, 58, 0, 6, 11, 0)
FIRST_SERIAL = 0x3855_0000_0001
OTHER_SERIAL = 0x0000_0100_0000  # the difference of a second axis with the same id
MODES = {Control.TORQUE: Mode.TORQUE, Control.VELOCITY: Mode.VELOCITY, Control.POSITION: Mode.POSITION}


@dataclass(frozen=True)
class Configuration:
    """What an axis has in its memory without power, and begins with."""

    watchdog_enabled: bool
    watchdog_timeout_s: float
    current_soft_max_a: float
    vel_limit_turns_s: float


@dataclass
class Axis:
    """One axis: settings, inputs, state."""

    node: int
    torque_constant: float
    saved: Configuration
    state: int = State.IDLE
    errors: int = 0
    disarm_reason: int = 0
    control: int = Control.POSITION
    inputs: tuple[float, ...] = (0.0, 0.0, 0.0)  # by `Control`, from torque on: N·m, turns/s, turns
    position_gain: float = 20.0
    velocity_gain: float = 0.16
    fed_us: float = 0.0

    def __post_init__(self) -> None:
        """The settings in force are those that are saved; `Set_Limits` changes two of them."""
        self.watchdog_us = self.saved.watchdog_timeout_s * 1e6 if self.saved.watchdog_enabled else math.inf
        self.current_soft_max_a = self.saved.current_soft_max_a
        self.vel_limit_turns_s = self.saved.vel_limit_turns_s

    def setting(self, setting: Setting) -> float:
        """A setting in force."""
        match setting:
            case Setting.WATCHDOG_ENABLED:
                return self.saved.watchdog_enabled
            case Setting.WATCHDOG_TIMEOUT:
                return self.saved.watchdog_timeout_s
            case Setting.CURRENT:
                return self.current_soft_max_a
            case Setting.SPEED:
                return self.vel_limit_turns_s


class EmulatedOdrive(CanEmulator):
    """All axes of a driver type."""

    def __init__(self, everybody: Sequence[Joint], settings: Any, body: EmulatedBody, *ends: Any) -> None:
        super().__init__(settings, body, *ends)
        files = read_all_endpoints(settings.endpoints)
        version = EMULATED.firmware, EMULATED.hardware
        self._endpoints = next((file for file in files if (file.firmware, file.hardware) == version), EMULATED)
        self.axes = [
            Axis(
                node=built.id,
                torque_constant=built.motor.torque_constant_nm_per_a or TWIN_CONSTANT,
                saved=configuration_of(joint, settings),
            )
            for joint, built in zip(everybody, body.joints, strict=True)
        ]
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
        """Settings that were not saved are lost."""
        self.axes[i] = Axis(self.axes[i].node, self.axes[i].torque_constant, self.axes[i].saved)
        self._drive(i, self.axes[i])

    def take(self, i: int, frame: Frame) -> None:
        """Questions have no data, but for those for settings."""
        known, axis = Message(parted(frame)[1]), self.axes[i]
        if known == Message.RX_SDO:
            self._answer_setting(i, frame.data)
            return
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
                axis.vel_limit_turns_s, axis.current_soft_max_a = values
            case Message.SET_POSITION_GAIN:
                axis.position_gain = values[0]
            case Message.SET_VELOCITY_GAINS:
                axis.velocity_gain = values[0]
            case _:
                return
        self._drive(i, axis)

    def _answer_setting(self, i: int, data: bytes) -> None:
        """Say a setting; an endpoint that there is not is no answer. What others write is out of this emulation."""
        opcode, endpoint, _ = SDO_HEAD.unpack_from(data)
        setting, axis = self._endpoints.setting_at(endpoint), self.axes[i]
        if setting is not None and opcode == READ_SETTING:
            value = FORMATS[TYPES[setting]].pack(axis.setting(setting))
            self.say(i, say_setting(axis.node, endpoint, value))

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
        limit_nm = axis.current_soft_max_a * axis.torque_constant
        speed_rad_s = axis.vel_limit_turns_s * TURN
        self.body.drive(i, mode, target if mode else 0.0, limit_nm, axis.position_gain * damping, damping, speed_rad_s)

    def _fail(self, i: int, axis: Axis, error: Error) -> None:
        axis.errors |= error
        axis.disarm_reason, axis.state = error, State.IDLE
        self._drive(i, axis)

    def each_step(self, now_us: float) -> None:
        """Watchdogs, heat, heartbeats."""
        for i, axis in enumerate(self.axes):
            if axis.state == State.CLOSED_LOOP and now_us - axis.fed_us > axis.watchdog_us:
                self._fail(i, axis, Error.WATCHDOG_TIMER_EXPIRED)
        if now_us - self._heartbeat_us < HEARTBEAT_US:
            return
        self._heartbeat_us = now_us
        for i, axis in enumerate(self.axes):
            if self.body.too_hot(i):
                self._fail(i, axis, Error.MOTOR_OVER_TEMP)
            self.say(i, self._message(i, axis, Message.HEARTBEAT))


def configuration_of(joint: Joint, settings: Any) -> Configuration:
    """Return what an axis is configured for: what its joint in the robot file needs, unless the scenario differs."""
    mounted = settings.mounted.get(joint.name)
    watchdog_s, current_a, speed = settings.watchdog_s, needed_current_a(joint), joint.limits.speed_rad_s
    return Configuration(
        watchdog_enabled=_said(mounted, "watchdog_timeout_s", watchdog_s) > 0,
        watchdog_timeout_s=_said(mounted, "watchdog_timeout_s", watchdog_s),
        current_soft_max_a=_said(mounted, "current_soft_max_a", current_a),
        vel_limit_turns_s=_said(mounted, "vel_limit_turns_s", speed * joint.drive.gear / TURN),
    )


def _said(mounted: Any, field: str, otherwise: float) -> float:
    value = getattr(mounted, field, None)  # beside drives of other types the scenario has no such fields
    return otherwise if value is None else value
