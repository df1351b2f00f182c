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
from snakesim_can_backend.odrive.endpoints import EMULATED, FORMATS, TYPES, AxisSetting, read_all_endpoints
from snakesim_can_backend.odrive.protocol import (
    PAYLOADS,
    READ_SETTING,
    SDO_HEAD,
    AxisError,
    AxisState,
    ControlMode,
    MessageId,
    encode_message,
    encode_request,
    encode_setting_answer,
    split_id,
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
MODES = {ControlMode.TORQUE: Mode.TORQUE, ControlMode.VELOCITY: Mode.VELOCITY, ControlMode.POSITION: Mode.POSITION}


@dataclass(frozen=True)
class AxisConfiguration:
    """What an axis has in its memory without power, and begins with."""

    watchdog_enabled: bool
    watchdog_timeout_s: float
    current_soft_max_a: float
    vel_limit_turns_s: float


@dataclass
class EmulatedAxis:
    """One axis: settings, inputs, state."""

    node: int
    torque_constant: float
    saved: AxisConfiguration
    state: int = AxisState.IDLE
    errors: int = 0
    disarm_reason: int = 0
    control: int = ControlMode.POSITION
    inputs: tuple[float, ...] = (0.0, 0.0, 0.0)  # by `Control`, from torque on: N·m, turns/s, turns
    position_gain: float = 20.0
    velocity_gain: float = 0.16
    fed_us: float = 0.0

    def __post_init__(self) -> None:
        """The settings in force are those that are saved; `Set_Limits` changes two of them."""
        self.watchdog_us = self.saved.watchdog_timeout_s * 1e6 if self.saved.watchdog_enabled else math.inf
        self.current_soft_max_a = self.saved.current_soft_max_a
        self.vel_limit_turns_s = self.saved.vel_limit_turns_s

    def setting(self, setting: AxisSetting) -> float:
        """A setting in force."""
        match setting:
            case AxisSetting.WATCHDOG_ENABLED:
                return self.saved.watchdog_enabled
            case AxisSetting.WATCHDOG_TIMEOUT:
                return self.saved.watchdog_timeout_s
            case AxisSetting.CURRENT:
                return self.current_soft_max_a
            case AxisSetting.SPEED:
                return self.vel_limit_turns_s


class EmulatedOdrive(CanEmulator):
    """All axes of a driver type."""

    def __init__(self, everybody: Sequence[Joint], settings: Any, body: EmulatedBody, *ends: Any) -> None:
        super().__init__(settings, body, *ends)
        files = read_all_endpoints(settings.endpoints)
        version = EMULATED.firmware, EMULATED.hardware
        self._endpoints = next((file for file in files if (file.firmware, file.hardware) == version), EMULATED)
        self.axes = [
            EmulatedAxis(
                node=built.id,
                torque_constant=built.motor.torque_constant_nm_per_a or TWIN_CONSTANT,
                saved=configuration_of(joint, settings),
            )
            for joint, built in zip(everybody, body.joints, strict=True)
        ]
        self._heartbeat_us = -math.inf
        self.on_step(0.0)

    def find_addressee(self, frame: Frame) -> int:
        """Its node."""
        return split_id(frame)[0]

    def duplicate_frame(self, frame: Frame) -> Frame:
        """Its own serial number in the address."""
        if split_id(frame)[1] != MessageId.ADDRESS or not frame.data:
            return frame
        node, serial, connection = PAYLOADS[MessageId.ADDRESS].unpack(frame.data)
        other = int.from_bytes(serial, "little") ^ OTHER_SERIAL
        return encode_message(node, MessageId.ADDRESS, node, other.to_bytes(6, "little"), connection)

    def restart(self, i: int) -> None:
        """Settings that were not saved are lost."""
        self.axes[i] = EmulatedAxis(self.axes[i].node, self.axes[i].torque_constant, self.axes[i].saved)
        self._drive(i, self.axes[i])

    def handle_frame(self, i: int, frame: Frame) -> None:
        """Questions have no data, but for those for settings."""
        known, axis = MessageId(split_id(frame)[1]), self.axes[i]
        if known == MessageId.RX_SDO:
            self._answer_setting(i, frame.data)
            return
        values = PAYLOADS[known].unpack(frame.data) if frame.data else ()
        if not values and known not in (MessageId.ESTOP, MessageId.CLEAR_ERRORS):
            self.say(i, self._message(i, axis, known))
        else:
            self._obey(i, axis, known, values)

    def _obey(self, i: int, axis: EmulatedAxis, message: MessageId, values: tuple[float, ...]) -> None:
        match message:
            case MessageId.ESTOP:
                self._fail(i, axis, AxisError.ESTOP_REQUESTED)
            case MessageId.CLEAR_ERRORS:
                axis.errors = 0
            case MessageId.SET_STATE if values[0] == AxisState.CLOSED_LOOP and not axis.errors:
                axis.fed_us = self.body.now_us
                axis.state = AxisState.CLOSED_LOOP
            case MessageId.SET_STATE:
                axis.state = AxisState.IDLE
            case MessageId.SET_MODE:
                axis.control = int(values[0])
            case MessageId.SET_POSITION | MessageId.SET_VELOCITY | MessageId.SET_TORQUE:
                axis.fed_us = self.body.now_us
                at = {MessageId.SET_TORQUE: 0, MessageId.SET_VELOCITY: 1, MessageId.SET_POSITION: 2}[message]
                axis.inputs = (*axis.inputs[:at], values[0], *axis.inputs[at + 1 :])
            case MessageId.SET_LIMITS:
                axis.vel_limit_turns_s, axis.current_soft_max_a = values
            case MessageId.SET_POSITION_GAIN:
                axis.position_gain = values[0]
            case MessageId.SET_VELOCITY_GAINS:
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
            self.say(i, encode_setting_answer(axis.node, endpoint, value))

    def _message(self, i: int, axis: EmulatedAxis, message: MessageId) -> Frame:
        angle, velocity, torque = self.body.read_shaft(i)
        values: tuple[Any, ...]
        match message:
            case MessageId.VERSION:
                values = VERSION
            case MessageId.ADDRESS:
                values = axis.node, (FIRST_SERIAL + i).to_bytes(6, "little"), 0
            case MessageId.HEARTBEAT:
                values = axis.errors, axis.state, 0, 0
            case MessageId.ERROR:
                values = axis.errors, axis.disarm_reason
            case MessageId.MOTION:
                values = round(angle / TURN * COUNTS) / COUNTS, velocity / TURN
            case MessageId.CURRENT:
                values = torque / axis.torque_constant, torque / axis.torque_constant
            case MessageId.TEMPERATURE:
                motor_c, board_c = self.body.read_temperatures(i)
                values = board_c, motor_c
            case MessageId.SUPPLY:
                values = self.body.read_supply(i)
            case _:
                return encode_request(axis.node, message)
        return encode_message(axis.node, message, *values)

    def _drive(self, i: int, axis: EmulatedAxis) -> None:
        control = ControlMode(axis.control) if axis.control in list(ControlMode) else ControlMode.TORQUE
        mode = MODES[control] if axis.state == AxisState.CLOSED_LOOP else Mode.PASSIVE
        target = axis.inputs[control - 1] * (1.0 if control == ControlMode.TORQUE else TURN)
        damping = axis.velocity_gain / TURN
        limit_nm = axis.current_soft_max_a * axis.torque_constant
        speed_rad_s = axis.vel_limit_turns_s * TURN
        self.body.drive_motor(
            i, mode, target if mode else 0.0, limit_nm, axis.position_gain * damping, damping, speed_rad_s
        )

    def _fail(self, i: int, axis: EmulatedAxis, error: AxisError) -> None:
        axis.errors |= error
        axis.disarm_reason, axis.state = error, AxisState.IDLE
        self._drive(i, axis)

    def on_step(self, now_us: float) -> None:
        """Watchdogs, heat, heartbeats."""
        for i, axis in enumerate(self.axes):
            if axis.state == AxisState.CLOSED_LOOP and now_us - axis.fed_us > axis.watchdog_us:
                self._fail(i, axis, AxisError.WATCHDOG_TIMER_EXPIRED)
        if now_us - self._heartbeat_us < HEARTBEAT_US:
            return
        self._heartbeat_us = now_us
        for i, axis in enumerate(self.axes):
            if self.body.is_too_hot(i):
                self._fail(i, axis, AxisError.MOTOR_OVER_TEMP)
            self.say(i, self._message(i, axis, MessageId.HEARTBEAT))


def configuration_of(joint: Joint, settings: Any) -> AxisConfiguration:
    """Return what an axis is configured for: what its joint in the robot file needs, unless the scenario differs."""
    mounted = settings.mounted.get(joint.name)
    watchdog_s, current_a, speed = settings.watchdog_s, needed_current_a(joint), joint.limits.speed_rad_s
    return AxisConfiguration(
        watchdog_enabled=_said(mounted, "watchdog_timeout_s", watchdog_s) > 0,
        watchdog_timeout_s=_said(mounted, "watchdog_timeout_s", watchdog_s),
        current_soft_max_a=_said(mounted, "current_soft_max_a", current_a),
        vel_limit_turns_s=_said(mounted, "vel_limit_turns_s", speed * joint.drive.gear / TURN),
    )


def _said(mounted: Any, field: str, otherwise: float) -> float:
    value = getattr(mounted, field, None)  # beside drives of other types the scenario has no such fields
    return otherwise if value is None else value
