"""ODrive axes as a driver type of drives on CAN.

Position mode is the axis' own cascade, with gains that make it the PD law of the robot file; passive is a torque of 0,
without a change of state. Heartbeats say state and errors.
"""

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from snakesim_can_backend.can_drives.drives import HOST, CanDrives
from snakesim_can_backend.odrive.endpoints import EMULATED, FORMATS, TYPES, AxisSetting, Endpoints, read_all_endpoints
from snakesim_can_backend.odrive.protocol import (
    FIRMWARE,
    FROM_HOST,
    PASSTHROUGH,
    PAYLOADS,
    WRITE_SETTING,
    AxisError,
    AxisState,
    ControlMode,
    MessageId,
    decode_setting_answer,
    describe_errors,
    encode_message,
    encode_request,
    encode_setting_request,
    split_id,
)
from snakesim_can_backend.protocol.definitions import Frame
from snakesim_drivers.kit.drive_states import DriveCommand
from snakesim_hal.model.joints import Joint
from snakesim_hal.wire.messages import Mode

TURN = 2 * math.pi
_log = logging.getLogger("snakesim.drivers")
TWIN_CONSTANT = 1.0  # N·m/A, of emulators whose robot file says none
UNKNOWN_MAX_CURRENT_A = 1.0  # where it cannot be read what an axis is configured for: even a small motor stands it
NO_LIMIT_SENT = -1.0
READING = 1e-3  # relative: settings are single precision, and people round them
LEFT_BEHIND = AxisError.WATCHDOG_TIMER_EXPIRED  # by a driver that was killed
CONTROLS = {
    Mode.PASSIVE: ControlMode.TORQUE,
    Mode.TORQUE: ControlMode.TORQUE,
    Mode.VELOCITY: ControlMode.VELOCITY,
    Mode.POSITION: ControlMode.POSITION,
}


@dataclass
class Axis:
    """One axis: its settings, at its shaft, and which of them it has been sent."""

    torque_constant: float  # N·m/A
    position_gain: float  # 1/s
    damping: float  # N·m / (turn/s), position mode
    velocity_gain: float  # N·m / (turn/s), velocity mode
    speed_limit: float  # turns/s
    torque_nm: float  # that the joint may ask for
    max_current_a: float  # never sends more
    configured: dict[AxisSetting, float] = field(default_factory=dict[AxisSetting, float])  # as it says in the bring-up
    errors: int = 0
    mode: Mode | None = None
    limit_nm: float = NO_LIMIT_SENT


class Axes(CanDrives):
    """All axes of a bus."""

    unheard = "does not say its version: it is off, has another id or bit rate, or firmware 0.5, which does not say it"

    def __init__(self, _everybody: object, settings: Any, joints: Sequence[Joint], *rest: Any, **kit: Any) -> None:
        super().__init__(joints, *rest, **kit)
        self._allowed_a: float = settings.max_current_a or math.inf
        self._watchdog_s: float = settings.watchdog_s
        self._files = read_all_endpoints(settings.endpoints)
        if self.emulated and not self._files:
            self._files = [EMULATED]
        self._hardware = [""] * len(joints)
        unknown_a = settings.max_current_a or UNKNOWN_MAX_CURRENT_A
        if not self._files:
            _log.warning(
                "%s: watchdog, current and speed limits of these axes are unknown: the driver sets no more than %g A. "
                "Name the flat_endpoints.json of their firmware in `backends.odrive.endpoints`, and it reads them",
                self.wire.channel,
                unknown_a,
            )
        self.axes = [axis_of(joint, unknown_a) for joint in joints]

    def sender(self, frame: Frame) -> int | None:
        """Questions have no data."""
        node, message = split_id(frame)
        if not frame.data and message not in (MessageId.ESTOP, MessageId.CLEAR_ERRORS):
            return None
        if message == MessageId.RX_SDO:  # a question of another program disturbs nobody
            return HOST if frame.data[0] == WRITE_SETTING else None
        return HOST if message in FROM_HOST else node

    def hear(self, i: int, frame: Frame) -> None:
        """Answers and heartbeats."""
        message, axis, readings = MessageId(split_id(frame)[1]), self.axes[i], self.readings
        if message == MessageId.TX_SDO:
            self._hear_setting(i, frame.data)
            return
        values = PAYLOADS[message].unpack(frame.data)
        match message:
            case MessageId.MOTION:
                readings.set_motion(i, values[0] * TURN, values[1] * TURN)
            case MessageId.CURRENT:
                readings.set_torque(i, values[1] * axis.torque_constant)
            case MessageId.SUPPLY:
                readings.set_supply(i, values[0], values[1])
            case MessageId.TEMPERATURE:
                readings.set_temperatures(i, values[1], values[0])
            case MessageId.HEARTBEAT:
                self.states.note_report(i, enabled=values[1] == AxisState.CLOSED_LOOP, state=f"in state {values[1]}")
                self._errs(i, values[0])
                if values[1] == AxisState.IDLE and not self.states.drives[i].should_follow:
                    self.give_back(i)  # so that a driver that is killed while its motors are off leaves no lower limit
            case MessageId.ERROR:
                self._errs(i, values[0])
            case MessageId.VERSION:
                self.firmware[i] = values[4:7]
                readings.set_identity(i, firmware=".".join(map(str, values[4:7])))
                self._hardware[i] = ".".join(map(str, values[1:4]))
                if values[4:6] == FIRMWARE:  # 0.5 would take the question for a new node id
                    self._ask(i, MessageId.ADDRESS)
                    self._ask_setting(i)
            case MessageId.ADDRESS:
                self.note_serial(i, f"{int.from_bytes(values[1], 'little'):012X}")
            case _:
                pass

    def _errs(self, i: int, errors: int) -> None:
        self.readings.mark_checked(i)
        drive, self.axes[i].errors = self.states.drives[i], errors
        drive.errors = describe_errors(errors & ~AxisError.ESTOP_REQUESTED if drive.emergency_stopped else errors)

    # --- what an axis is configured for -------------------------------------------------------------------------

    def identify(self, i: int) -> None:
        """Version and errors; then one setting after another."""
        if self.firmware[i]:
            self._ask_setting(i)
        else:
            self._ask(i, MessageId.VERSION, MessageId.ERROR)

    def identified(self, i: int) -> bool:
        """Its firmware, and what it is configured for where that can be read."""
        return bool(self.firmware[i]) and (self._endpoints(i) is None or not self._unread(i))

    def unfit(self, i: int) -> str:
        """Another firmware, or a configuration that does not suit the joint."""
        firmware = self._firmware_name(i)
        if self.firmware[i][:2] != FIRMWARE:
            return f"has firmware {firmware}; this driver knows {FIRMWARE[0]}.{FIRMWARE[1]}"
        if not self._files:  # the limits are unknown: `Axis.max_current_a` caps the current
            return ""
        if self._endpoints(i) is None:
            files = ", ".join(f"{file.firmware} on {file.hardware}" for file in self._files)
            return (
                f"has firmware {firmware} on hardware {self._hardware[i]}, and `backends.odrive.endpoints` names files "
                f"of {files}: add the flat_endpoints.json of its firmware"
            )
        if unread := self._unread(i):
            return f"does not say `{unread[0]}`: is `backends.odrive.endpoints` of its firmware?"
        axis = self.axes[i]
        axis.max_current_a = min(axis.configured[AxisSetting.CURRENT], self._allowed_a)
        return "; ".join(objections(axis, self._watchdog_s))

    def _firmware_name(self, i: int) -> str:
        return ".".join(map(str, self.firmware[i]))

    def _endpoints(self, i: int) -> Endpoints | None:
        """Where this axis has its settings; None: not known."""
        version = self._firmware_name(i), self._hardware[i]
        return next((file for file in self._files if (file.firmware, file.hardware) == version), None)

    def _unread(self, i: int) -> list[AxisSetting]:
        return [setting for setting in AxisSetting if setting not in self.axes[i].configured]

    def _ask_setting(self, i: int) -> None:
        """Ask for the next setting that is not known yet; one at a time, so that queues do not fill."""
        endpoints, unread = self._endpoints(i), self._unread(i)
        if endpoints is not None and unread:
            self.wire.send(encode_setting_request(self.nodes[i], endpoints.ids[unread[0]]))

    def _hear_setting(self, i: int, data: bytes) -> None:
        endpoints = self._endpoints(i)
        endpoint, value = decode_setting_answer(data)
        setting = None if endpoints is None else endpoints.setting_at(endpoint)
        if setting is None or setting not in self._unread(i):  # later the driver has lowered limits
            return
        (self.axes[i].configured[setting],) = FORMATS[TYPES[setting]].unpack(value)
        self._ask_setting(i)

    def begin_anew(self) -> None:
        """Also what they are configured for."""
        super().begin_anew()
        for axis in self.axes:
            axis.configured.clear()

    def give_back(self, i: int) -> None:
        """The limits that an axis was configured for, if this driver has lowered them."""
        axis = self.axes[i]
        if axis.limit_nm < 0 or self._unread(i):
            return
        limits = axis.configured[AxisSetting.SPEED], axis.configured[AxisSetting.CURRENT]
        if self._send(i, MessageId.SET_LIMITS, *limits):
            axis.limit_nm = NO_LIMIT_SENT

    # --- a tick -------------------------------------------------------------------------------------------------

    def ask(self, i: int) -> bool:
        """Encoder estimates and current; before them errors, of an axis that may have stopped by itself."""
        if i in self.readings.drives_to_check:
            self._ask(i, MessageId.ERROR)
        return self._ask(i, MessageId.MOTION, MessageId.CURRENT)

    def ask_health(self, i: int) -> None:
        """Supply, temperatures and errors; and the serial number, to notice a second axis of its id."""
        self._ask(i, MessageId.SUPPLY, MessageId.TEMPERATURE, MessageId.ERROR, MessageId.ADDRESS)

    def setpoint(self, i: int, mode: Mode, target: float, limit_nm: float) -> None:
        """An input; before it limits, after it gains and mode, if they change."""
        axis = self.axes[i]
        if limit_nm != axis.limit_nm:
            # This assigns `current_soft_max`, so it must never be more than the axis was configured for.
            current_a = min(limit_nm / axis.torque_constant, axis.max_current_a)
            if self._send(i, MessageId.SET_LIMITS, axis.speed_limit, current_a):
                axis.limit_nm = limit_nm
        match mode:
            case Mode.POSITION:
                self._send(i, MessageId.SET_POSITION, target / TURN, 0, 0)
            case Mode.VELOCITY:
                self._send(i, MessageId.SET_VELOCITY, target / TURN, 0.0)
            case Mode.TORQUE | Mode.PASSIVE:
                self._send(i, MessageId.SET_TORQUE, target)
        if mode != axis.mode:
            gain = axis.damping if mode == Mode.POSITION else axis.velocity_gain
            sent = self._send(i, MessageId.SET_VELOCITY_GAINS, gain, 0.0)
            if self._send(i, MessageId.SET_MODE, CONTROLS[mode], PASSTHROUGH) and sent:
                axis.mode = mode

    def tell(self, i: int, word: DriveCommand) -> None:
        """By its state; an emergency stop is an error that it keeps."""
        if word == "stop":
            self._send(i, MessageId.ESTOP)
        else:
            self._send(i, MessageId.SET_STATE, AxisState.CLOSED_LOOP if word == "follow" else AxisState.IDLE)
        if word != "follow":
            self.axes[i].mode = None

    def set_up(self, i: int) -> None:
        """Its gain; the rest is written when it follows."""
        axis = self.axes[i]
        axis.limit_nm, axis.mode = NO_LIMIT_SENT, None
        self._send(i, MessageId.SET_POSITION_GAIN, axis.position_gain)

    def forgive(self, i: int) -> None:
        """An expired watchdog."""
        if self.axes[i].errors and not self.axes[i].errors & ~LEFT_BEHIND:
            self._send(i, MessageId.CLEAR_ERRORS)

    def clear_errors(self, i: int) -> None:
        """And ask what is left."""
        self._send(i, MessageId.CLEAR_ERRORS)
        self._ask(i, MessageId.ERROR)

    def _send(self, i: int, message: MessageId, *values: float) -> bool:
        return self.wire.send(encode_message(self.nodes[i], message, *values))

    def _ask(self, i: int, *questions: MessageId) -> bool:
        taken = [self.wire.send(encode_request(self.nodes[i], question)) for question in questions]
        return all(taken)


def axis_of(joint: Joint, max_current_a: float) -> Axis:
    """An axis with the gains of its joint, at its shaft."""
    motor, gear = joint.motor, joint.drive.gear
    return Axis(
        torque_constant=motor.torque_constant_nm_per_a or TWIN_CONSTANT,
        position_gain=motor.stiffness_nm_per_rad / motor.damping_nm_s_per_rad,
        damping=motor.damping_nm_s_per_rad / gear**2 * TURN,
        velocity_gain=motor.velocity_gain_nm_s_per_rad / gear**2 * TURN,
        speed_limit=joint.limits.speed_rad_s * gear / TURN,
        torque_nm=joint.limits.torque_nm / gear,
        max_current_a=max_current_a,
    )


def needed_current_a(joint: Joint) -> float:
    """Return the current that a joint's torque limit needs."""
    constant = joint.motor.torque_constant_nm_per_a or TWIN_CONSTANT
    return joint.limits.torque_nm / joint.drive.gear / constant


def objections(axis: Axis, watchdog_s: float) -> Iterator[str]:
    """Yield what in the configuration of an axis does not suit its joint. NaN suits nothing."""
    configured = axis.configured
    timeout_s = configured[AxisSetting.WATCHDOG_TIMEOUT]
    if not configured[AxisSetting.WATCHDOG_ENABLED]:
        yield f"has its watchdog off: set `enable_watchdog` = True and `watchdog_timeout` = {watchdog_s:g}, and save"
    elif not abs(timeout_s - watchdog_s) <= READING * watchdog_s:
        yield (
            f"has a watchdog of {timeout_s:g} s, and `backends.odrive.watchdog_s` says {watchdog_s:g} s: correct "
            f"`watchdog_timeout` and save, or correct the scenario"
        )
    current_a = configured[AxisSetting.CURRENT]
    if not axis.torque_nm / axis.torque_constant <= current_a * (1 + READING):
        yield (
            f"has a current limit (`current_soft_max`) of {current_a:.4g} A, which is "
            f"{current_a * axis.torque_constant:.3g} N·m, and its joint may ask for {axis.torque_nm:.3g} N·m: raise "
            f"the one, or lower `torque_nm`. If a driver was killed, it may have left a lower limit: restart the axis"
        )
    speed = configured[AxisSetting.SPEED]
    if not axis.speed_limit <= speed * (1 + READING):
        yield (
            f"has a speed limit (`vel_limit`) of {speed:.4g} turns/s, and its joint may turn at "
            f"{axis.speed_limit:.4g}: raise the one, or lower `speed_rad_s`"
        )
