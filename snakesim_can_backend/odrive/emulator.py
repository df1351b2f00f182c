"""Emulated ODrive axes: the messages, states, limits and watchdog of CANSimple, on a body that a physics model moves.

They do *not* simulate calibration, encoders that slip, the velocity integrator, the speed limit of torque mode, the
error of overspeed, trajectories, arbitration and bit rate.
"""

import math
from dataclasses import dataclass
from typing import Any

from snakesim_can_backend.can_drives.emulator import CanEmulator, CanEmulatorContext
from snakesim_can_backend.odrive.axes import (
    EMULATED_CONSTANT_NM_PER_A,
    REVOLUTION_RAD,
    compute_required_current_a,
)
from snakesim_can_backend.odrive.endpoints import (
    EMULATED,
    SETTING_TYPES,
    VALUE_FORMATS,
    AxisSetting,
    read_all_endpoints,
)
from snakesim_can_backend.odrive.protocol import (
    PAYLOADS,
    READ_SETTING,
    SDO_HEADER,
    AxisError,
    AxisState,
    ControlMode,
    MessageId,
    encode_message,
    encode_request,
    encode_setting_answer,
    split_id,
)
from snakesim_can_backend.odrive.settings import MountedAxis, OdriveSettings
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.wire.messages import JointMode

HEARTBEAT_US = 100_000.0  # ODrive's default period
COUNTS_PER_TURN = 16384  # of the encoder
VERSION = (2, 4, 4, 58, 0, 6, 11, 0)  # protocol, hardware (3), firmware (3), unreleased
FIRST_SERIAL = 0x3855_0000_0001
# In which the serial number of a second axis with the same id differs.
DUPLICATE_SERIAL_BITS = 0x0000_0100_0000
MODE_BY_CONTROL_MODE = {
    ControlMode.TORQUE: JointMode.TORQUE,
    ControlMode.VELOCITY: JointMode.VELOCITY,
    ControlMode.POSITION: JointMode.POSITION,
}
# `EmulatedAxis.setpoints`.
SETPOINT_INDEX = {MessageId.SET_TORQUE: 0, MessageId.SET_VELOCITY: 1, MessageId.SET_POSITION: 2}


@dataclass(frozen=True)
class AxisConfiguration:
    """What an axis has in its nonvolatile memory, and starts with."""

    watchdog_enabled: bool
    watchdog_timeout_s: float
    current_soft_max_a: float
    vel_limit_turns_s: float


@dataclass
class EmulatedAxis:
    """One axis: settings, inputs, state."""

    node_id: int
    torque_constant: float  # N·m/A
    saved: AxisConfiguration
    # State.
    state: int = AxisState.IDLE
    errors: int = 0
    disarm_reason: int = 0
    watchdog_fed_us: float = 0.0  # when the watchdog was fed
    # Inputs and gains.
    control_mode: int = ControlMode.POSITION
    # Torque in N·m, velocity in turns/s, position in turns.
    setpoints: tuple[float, ...] = 0.0, 0.0, 0.0
    position_gain: float = 20.0  # 1/s
    velocity_gain: float = 0.16  # N·m / (turn/s)

    def __post_init__(self) -> None:
        """Start with the saved settings; `Set_Limits` changes two of them."""
        self.watchdog_us = math.inf
        if self.saved.watchdog_enabled:
            self.watchdog_us = self.saved.watchdog_timeout_s * 1e6
        self.current_soft_max_a = self.saved.current_soft_max_a
        self.vel_limit_turns_s = self.saved.vel_limit_turns_s

    def read_setting(self, setting: AxisSetting) -> float:
        """Return the current value of a setting."""
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

    def __init__(self, context: CanEmulatorContext) -> None:
        """Start one emulated axis for each joint, configured as the joint needs it unless the scenario differs.

        Args:
            context: Joints, settings, buses, and the body that the axes move.
        """
        super().__init__(context)
        settings: OdriveSettings = context.settings
        self._endpoints = EMULATED
        for file in read_all_endpoints(settings.endpoints):
            if (file.firmware, file.hardware) == (EMULATED.firmware, EMULATED.hardware):
                self._endpoints = file
                break
        self.axes = [
            EmulatedAxis(
                node_id=true_joint.id,
                # An operator configures it as in the robot file, also if the motor has another one.
                torque_constant=joint.motor.torque_constant_nm_per_a or EMULATED_CONSTANT_NM_PER_A,
                saved=make_configuration(joint, settings),
            )
            for joint, true_joint in zip(context.joints, context.body.joints, strict=True)
        ]
        self._last_heartbeat_us = -math.inf
        self.on_step(0.0)

    def find_destination_node(self, frame: CanFrame) -> int:
        """Return the node of a frame."""
        node, _ = split_id(frame)
        return node

    def duplicate_frame(self, frame: CanFrame) -> CanFrame:
        """Return the frame of a second axis: it has another serial number in its address."""
        if split_id(frame)[1] != MessageId.ADDRESS or not frame.data:
            return frame
        node, serial, connection = PAYLOADS[MessageId.ADDRESS].unpack(frame.data)
        other_serial = int.from_bytes(serial, "little") ^ DUPLICATE_SERIAL_BITS
        return encode_message(
            node, MessageId.ADDRESS, node, other_serial.to_bytes(6, "little"), connection
        )

    def restart(self, i: int) -> None:
        """Restart an axis. It loses the settings that were not saved."""
        axis = self.axes[i]
        self.axes[i] = EmulatedAxis(axis.node_id, axis.torque_constant, axis.saved)
        self._drive_motor(i, self.axes[i])

    def handle_frame(self, i: int, frame: CanFrame) -> None:
        """Send the report that a frame requests, or execute its command. Requests have no data, except for settings."""
        message_id = MessageId(split_id(frame)[1])
        axis = self.axes[i]
        if message_id == MessageId.RX_SDO:
            self._answer_setting(i, frame.data)
            return
        values = PAYLOADS[message_id].unpack(frame.data) if frame.data else ()
        if not values and message_id not in (MessageId.ESTOP, MessageId.CLEAR_ERRORS):
            self.send_frame(i, self._make_report(i, axis, message_id))
        else:
            self._execute_command(i, axis, message_id, values)

    def list_enabled(self) -> list[bool]:
        return [axis.state == AxisState.CLOSED_LOOP for axis in self.axes]

    def on_step(self, now_us: float) -> None:
        """Stop axes whose watchdog has expired; at each heartbeat, also those that are too hot."""
        for i, axis in enumerate(self.axes):
            if (
                axis.state == AxisState.CLOSED_LOOP
                and now_us - axis.watchdog_fed_us > axis.watchdog_us
            ):
                self._fail(i, axis, AxisError.WATCHDOG_TIMER_EXPIRED)
        if now_us - self._last_heartbeat_us < HEARTBEAT_US:
            return
        self._last_heartbeat_us = now_us
        for i, axis in enumerate(self.axes):
            if self.body.is_too_hot(i):
                self._fail(i, axis, AxisError.MOTOR_OVER_TEMP)
            self.send_frame(i, self._make_report(i, axis, MessageId.HEARTBEAT))

    # --- inside -----------------------------------------------------------------------------------------------

    def _execute_command(
        self, i: int, axis: EmulatedAxis, message_id: MessageId, values: tuple[float, ...]
    ) -> None:
        """Execute a command that the host has sent to an axis; an unknown command has no effect.

        Args:
            i: Index of the axis.
            axis: State of the axis, which is changed.
            message_id: Id of the command.
            values: Values of the payload of the command, in the units of ODrive.
        """
        match message_id:
            case MessageId.ESTOP:
                self._fail(i, axis, AxisError.ESTOP_REQUESTED)
            case MessageId.CLEAR_ERRORS:
                axis.errors = 0
            case MessageId.SET_STATE if values[0] == AxisState.CLOSED_LOOP and not axis.errors:
                axis.watchdog_fed_us = self.body.now_us
                axis.state = AxisState.CLOSED_LOOP
            case MessageId.SET_STATE:
                axis.state = AxisState.IDLE
            case MessageId.SET_MODE:
                axis.control_mode = int(values[0])
            case MessageId.SET_POSITION | MessageId.SET_VELOCITY | MessageId.SET_TORQUE:
                axis.watchdog_fed_us = self.body.now_us
                index = SETPOINT_INDEX[message_id]
                axis.setpoints = (*axis.setpoints[:index], values[0], *axis.setpoints[index + 1 :])
            case MessageId.SET_LIMITS:
                axis.vel_limit_turns_s, axis.current_soft_max_a = values
            case MessageId.SET_POSITION_GAIN:
                axis.position_gain = values[0]
            case MessageId.SET_VELOCITY_GAINS:
                axis.velocity_gain = values[0]
            case _:
                return
        self._drive_motor(i, axis)

    def _answer_setting(self, i: int, data: bytes) -> None:
        """Send the setting that a frame requests; unknown endpoints get no response, and writing is not emulated."""
        opcode, endpoint, _ = SDO_HEADER.unpack_from(data)
        setting = self._endpoints.find_setting(endpoint)
        axis = self.axes[i]
        if setting is not None and opcode == READ_SETTING:
            value = VALUE_FORMATS[SETTING_TYPES[setting]].pack(axis.read_setting(setting))
            self.send_frame(i, encode_setting_answer(axis.node_id, endpoint, value))

    def _make_report(self, i: int, axis: EmulatedAxis, message_id: MessageId) -> CanFrame:
        """Return a frame in which an axis reports values of its state.

        Args:
            i: Index of the axis.
            axis: State of the axis.
            message_id: Id of the message that the host has requested or that is due.

        Returns:
            The frame, without data if the axis does not know the message.
        """
        angle_rad, velocity_rad_s, torque_nm = self.body.read_shaft(i)
        values: tuple[Any, ...]
        match message_id:
            case MessageId.VERSION:
                values = VERSION
            case MessageId.ADDRESS:
                values = (axis.node_id, (FIRST_SERIAL + i).to_bytes(6, "little"), 0)
            case MessageId.HEARTBEAT:
                values = (axis.errors, axis.state, 0, 0)
            case MessageId.ERROR:
                values = (axis.errors, axis.disarm_reason)
            case MessageId.MOTION:
                counts = round(angle_rad / REVOLUTION_RAD * COUNTS_PER_TURN)
                values = (counts / COUNTS_PER_TURN, velocity_rad_s / REVOLUTION_RAD)
            case MessageId.CURRENT:
                current_a = torque_nm / axis.torque_constant
                values = (current_a, current_a)
            case MessageId.TEMPERATURE:
                motor_c, board_c = self.body.read_temperatures(i)
                values = (board_c, motor_c)
            case MessageId.SUPPLY:
                values = self.body.read_supply(i)
            case _:
                return encode_request(axis.node_id, message_id)
        return encode_message(axis.node_id, message_id, *values)

    def _drive_motor(self, i: int, axis: EmulatedAxis) -> None:
        """Apply state, control mode, setpoints, gains and limits of an axis to its motor.

        An unknown control mode counts as torque control. The motor is passive unless the axis is in closed loop. An
        axis counts angles in turns, and the motor in rad.

        Args:
            i: Index of the axis.
            axis: State of the axis.
        """
        control_mode = ControlMode.TORQUE
        if axis.control_mode in list(ControlMode):
            control_mode = ControlMode(axis.control_mode)
        mode = JointMode.PASSIVE
        target = 0.0
        if axis.state == AxisState.CLOSED_LOOP:
            mode = MODE_BY_CONTROL_MODE[control_mode]
            setpoint = axis.setpoints[control_mode - 1]  # N·m, turns/s or turns
            target = setpoint
            if control_mode != ControlMode.TORQUE:
                target = setpoint * REVOLUTION_RAD  # rad/s or rad
        # The position controller of an axis demands a velocity, in turns/s for each turn of error, which is 1/s. The
        # velocity controller demands a torque. So the stiffness of the two is the product of their gains.
        damping = axis.velocity_gain / REVOLUTION_RAD  # N·m per turn/s -> N·m per rad/s
        stiffness = axis.position_gain * damping  # N·m/rad
        self.body.drive_motor(
            i,
            mode,
            target,
            limit_nm=axis.current_soft_max_a * axis.torque_constant,
            stiffness=stiffness,
            damping=damping,
            speed_rad_s=axis.vel_limit_turns_s * REVOLUTION_RAD,
        )

    def _fail(self, i: int, axis: EmulatedAxis, error: AxisError) -> None:
        axis.errors |= error
        axis.disarm_reason = error
        axis.state = AxisState.IDLE
        self._drive_motor(i, axis)


def make_configuration(joint: Joint, settings: OdriveSettings) -> AxisConfiguration:
    """Return the configuration of an emulated axis: what its joint needs, unless the settings override a value.

    Args:
        joint: Joint as the robot file describes it.
        settings: Settings of the driver type, with overrides for emulated axes in `mounted`.
    """
    mounted = settings.mounted.get(joint.name, MountedAxis())
    watchdog_timeout_s = settings.watchdog_s
    if mounted.watchdog_timeout_s is not None:
        watchdog_timeout_s = mounted.watchdog_timeout_s
    current_soft_max_a = compute_required_current_a(joint)
    if mounted.current_soft_max_a is not None:
        current_soft_max_a = mounted.current_soft_max_a
    vel_limit_turns_s = joint.limits.speed_rad_s * joint.drive.gear / REVOLUTION_RAD
    if mounted.vel_limit_turns_s is not None:
        vel_limit_turns_s = mounted.vel_limit_turns_s
    return AxisConfiguration(
        watchdog_enabled=watchdog_timeout_s > 0,
        watchdog_timeout_s=watchdog_timeout_s,
        current_soft_max_a=current_soft_max_a,
        vel_limit_turns_s=vel_limit_turns_s,
    )
