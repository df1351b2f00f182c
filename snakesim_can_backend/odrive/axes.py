"""ODrive axes on one CAN bus, as a driver type.

Position mode is the axis' own cascade, with gains that make it the PD law of the robot file; passive is a torque of 0,
without a change of state. Heartbeats report state and errors.
"""

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass, field

from snakesim_can_backend.can_drives.drives import HOST, CanDrives, CanDrivesContext
from snakesim_can_backend.odrive.endpoints import (
    EMULATED,
    SETTING_TYPES,
    VALUE_FORMATS,
    AxisSetting,
    EndpointIds,
    read_all_endpoints,
)
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
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_drivers.kit.drive_states import DriveCommand
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.wire.messages import JointMode

REVOLUTION_RAD = 2 * math.pi  # rad
EMULATED_CONSTANT_NM_PER_A = 1.0  # torque constant of emulated axes whose robot file names none
# Used if an axis' own limit cannot be read: even a small motor withstands it.
UNKNOWN_MAX_CURRENT_A = 1.0
NO_LIMIT_SENT = -1.0
RELATIVE_TOLERANCE = 1e-3  # relative: settings are single precision, and people round them
LEFTOVER_ERRORS = AxisError.WATCHDOG_TIMER_EXPIRED  # of a driver that was killed
CONTROL_MODES = {
    JointMode.PASSIVE: ControlMode.TORQUE,
    JointMode.TORQUE: ControlMode.TORQUE,
    JointMode.VELOCITY: ControlMode.VELOCITY,
    JointMode.POSITION: ControlMode.POSITION,
}

_log = logging.getLogger("snakesim.drivers")


@dataclass
class OdriveAxis:
    """One axis: what its joint needs, what the axis is configured for, and what this driver has sent."""

    # What its joint needs, at the shaft.
    torque_constant: float  # N·m/A
    position_gain: float  # 1/s
    damping: float  # N·m / (turn/s), position mode
    velocity_gain: float  # N·m / (turn/s), velocity mode
    speed_limit: float  # turns/s
    torque_nm: float  # that the joint may command
    # What the axis reports.
    max_current_a: float  # the driver never sends a higher limit
    # Read in bring-up.
    configured: dict[AxisSetting, float] = field(default_factory=dict[AxisSetting, float])
    errors: int = 0
    # What the driver has sent.
    mode: JointMode | None = None
    limit_nm: float = NO_LIMIT_SENT


class OdriveAxes(CanDrives):
    """All axes of a bus."""

    missing_identity_text = (
        "does not report its version: it is off, has another id or bit rate, or firmware "
        "0.5, which does not report it"
    )

    def __init__(self, context: CanDrivesContext) -> None:
        """Prepare to drive the axes on a bus, and read the endpoint files that the settings name.

        Endpoint files map settings of an axis to ids. Without them the limits of the axes cannot be read, so that the
        driver allows only a low current.

        Args:
            context: The open bus, its joints, and the settings of the driver type.

        Raises:
            ConfigError: An endpoint file cannot be read.
        """
        super().__init__(context)
        settings = context.settings
        self._max_allowed_current_a: float = settings.max_current_a or math.inf
        self._watchdog_s: float = settings.watchdog_s
        self._endpoint_files = read_all_endpoints(settings.endpoints)
        if self.emulated and not self._endpoint_files:
            self._endpoint_files = [EMULATED]
        self._hardware_versions = [""] * len(context.joints)
        fallback_max_current_a = settings.max_current_a or UNKNOWN_MAX_CURRENT_A
        if not self._endpoint_files:
            _log.warning(
                "%s: watchdog, current and speed limits of these axes are unknown: the driver sets no more than %g A. "
                "Name the flat_endpoints.json of their firmware in `backends.odrive.endpoints`, and it reads them",
                self.wire.channel,
                fallback_max_current_a,
            )
        self.axes = [make_axis(joint, fallback_max_current_a) for joint in context.joints]

    # --- frames that arrive -----------------------------------------------------------------------------------

    def find_sender(self, frame: CanFrame) -> int | None:
        """Return the node id of the sender, `HOST` for commands of another host, or None for requests.

        A request has no data. Requests of other programs are ignored, because they only read.
        """
        node, message_id = split_id(frame)
        if not frame.data and message_id not in (MessageId.ESTOP, MessageId.CLEAR_ERRORS):
            return None
        if message_id == MessageId.RX_SDO:
            return HOST if frame.data[0] == WRITE_SETTING else None
        return HOST if message_id in FROM_HOST else node

    def handle_response(self, i: int, frame: CanFrame) -> None:
        """Store the measurements, errors, version or setting that an axis reports in a frame.

        Args:
            i: Index of the axis on the bus.
            frame: A response or a heartbeat.
        """
        message_id = MessageId(split_id(frame)[1])
        if message_id == MessageId.TX_SDO:
            self._store_setting(i, frame.data)
            return
        values = PAYLOADS[message_id].unpack(frame.data)
        match message_id:
            case MessageId.MOTION:
                self.readings.set_motion(i, values[0] * REVOLUTION_RAD, values[1] * REVOLUTION_RAD)
            case MessageId.CURRENT:
                self.readings.set_torque(i, values[1] * self.axes[i].torque_constant)
            case MessageId.SUPPLY:
                self.readings.set_supply(i, values[0], values[1])
            case MessageId.TEMPERATURE:
                self.readings.set_temperatures(i, values[1], values[0])
            case MessageId.HEARTBEAT:
                self._handle_heartbeat(i, error_count=values[0], state=values[1])
            case MessageId.ERROR:
                self._store_errors(i, values[0])
            case MessageId.VERSION:
                self._store_version(i, hardware=values[1:4], firmware=values[4:7])
            case MessageId.ADDRESS:
                serial = int.from_bytes(values[1], "little")
                self.record_serial(i, f"{serial:012X}")
            case _:
                pass

    def _handle_heartbeat(self, i: int, error_count: int, state: int) -> None:
        self.states.record_report(
            i, enabled=state == AxisState.CLOSED_LOOP, state=f"in state {state}"
        )
        self._store_errors(i, error_count)
        if state == AxisState.IDLE and not self.states.drives[i].should_be_enabled:
            # A driver that is killed while its motors are off then leaves no lowered limits behind.
            self.restore_settings(i)

    def _store_errors(self, i: int, error_count: int) -> None:
        self.readings.mark_checked(i)
        self.axes[i].errors = error_count
        drive = self.states.drives[i]
        # This driver has requested it, so it is no fault of the drive.
        if drive.is_emergency_stopped:
            error_count &= ~AxisError.ESTOP_REQUESTED
        drive.errors = describe_errors(error_count)

    def _store_version(self, i: int, hardware: tuple[int, ...], firmware: tuple[int, ...]) -> None:
        self.firmware[i] = firmware
        self.readings.set_identity(i, firmware=_join_version(firmware))
        self._hardware_versions[i] = _join_version(hardware)
        # Firmware 0.5 would take the request for the address as a new node id.
        if firmware[:2] == FIRMWARE:
            self._request(i, MessageId.ADDRESS)
            self._request_next_setting(i)

    # --- what an axis is configured for -----------------------------------------------------------------------

    def request_identity(self, i: int) -> None:
        """Request version and errors of an axis; once the version is known, request one missing setting."""
        if self.firmware[i]:
            self._request_next_setting(i)
        else:
            self._request(i, MessageId.VERSION, MessageId.ERROR)

    def is_identified(self, i: int) -> bool:
        """Return whether an axis has sent its firmware version, and its settings where these can be read."""
        if not self.firmware[i]:
            return False
        return self._find_endpoints(i) is None or not self._list_missing_settings(i)

    def forget_identities(self) -> None:
        """Forget also the settings that the axes have reported."""
        super().forget_identities()
        for axis in self.axes:
            axis.configured.clear()

    def validate_drive(self, i: int) -> str:
        """Check the firmware and the configuration of an axis, and limit the driver to the axis' own current limit.

        Args:
            i: Index of the axis on the bus, whose version and settings have been read.

        Returns:
            The reasons why the axis does not suit its joint, as one text; an empty string if it does.
        """
        firmware = _join_version(self.firmware[i])
        if self.firmware[i][:2] != FIRMWARE:
            return f"has firmware {firmware}; this driver knows {FIRMWARE[0]}.{FIRMWARE[1]}"
        # The limits are unknown: `OdriveAxis.max_current_a` caps the current.
        if not self._endpoint_files:
            return ""
        if self._find_endpoints(i) is None:
            files = ", ".join(
                f"{file.firmware} on {file.hardware}" for file in self._endpoint_files
            )
            return (
                f"has firmware {firmware} on hardware {self._hardware_versions[i]}, and `backends.odrive.endpoints` "
                f"names files of {files}: add the flat_endpoints.json of its firmware"
            )
        missing = self._list_missing_settings(i)
        if missing:
            return (
                f"does not report `{missing[0]}`: is `backends.odrive.endpoints` of its firmware?"
            )
        axis = self.axes[i]
        axis.max_current_a = min(axis.configured[AxisSetting.CURRENT], self._max_allowed_current_a)
        return "; ".join(find_configuration_problems(axis, self._watchdog_s))

    def _find_endpoints(self, i: int) -> EndpointIds | None:
        """Return the endpoint ids of an axis' settings, or None if no file is of its firmware and hardware."""
        firmware = _join_version(self.firmware[i])
        for file in self._endpoint_files:
            if file.firmware == firmware and file.hardware == self._hardware_versions[i]:
                return file
        return None

    def _list_missing_settings(self, i: int) -> list[AxisSetting]:
        return [setting for setting in AxisSetting if setting not in self.axes[i].configured]

    def _request_next_setting(self, i: int) -> None:
        """Request the next setting that is not known yet; one at a time, so that queues do not fill."""
        endpoints = self._find_endpoints(i)
        missing = self._list_missing_settings(i)
        if endpoints is not None and missing:
            self.wire.send(encode_setting_request(self.node_ids[i], endpoints.ids[missing[0]]))

    def _store_setting(self, i: int, data: bytes) -> None:
        endpoints = self._find_endpoints(i)
        endpoint, value = decode_setting_answer(data)
        setting = None if endpoints is None else endpoints.find_setting(endpoint)
        if setting is None or setting not in self._list_missing_settings(i):
            return  # only the first answer counts: later the driver has lowered limits
        (self.axes[i].configured[setting],) = VALUE_FORMATS[SETTING_TYPES[setting]].unpack(value)
        self._request_next_setting(i)

    # --- settings and errors ----------------------------------------------------------------------------------

    def write_settings(self, i: int) -> None:
        """Write the position gain; the rest is written when the axis follows."""
        axis = self.axes[i]
        axis.limit_nm = NO_LIMIT_SENT
        axis.mode = None
        self._send(i, MessageId.SET_POSITION_GAIN, axis.position_gain)

    def restore_settings(self, i: int) -> None:
        """Write back the limits that an axis is configured for, if this driver has lowered them."""
        axis = self.axes[i]
        if axis.limit_nm < 0 or self._list_missing_settings(i):
            return
        speed = axis.configured[AxisSetting.SPEED]
        current_a = axis.configured[AxisSetting.CURRENT]
        if self._send(i, MessageId.SET_LIMITS, speed, current_a):
            axis.limit_nm = NO_LIMIT_SENT

    def clear_leftover_errors(self, i: int) -> None:
        """Clear an expired watchdog, if it is the only error."""
        errors = self.axes[i].errors
        if errors and not errors & ~LEFTOVER_ERRORS:
            self._send(i, MessageId.CLEAR_ERRORS)

    def clear_errors(self, i: int) -> None:
        """Clear all errors, and request those that persist."""
        self._send(i, MessageId.CLEAR_ERRORS)
        self._request(i, MessageId.ERROR)

    # --- a control cycle --------------------------------------------------------------------------------------

    def request_motion(self, i: int) -> bool:
        """Request encoder estimates and current; before them errors, if the axis may have stopped by itself."""
        if i in self.readings.drives_to_check:
            self._request(i, MessageId.ERROR)
        return self._request(i, MessageId.MOTION, MessageId.CURRENT)

    def request_health(self, i: int) -> None:
        """Request supply, temperatures and errors; and the serial number, to notice a second axis with this id."""
        self._request(
            i, MessageId.SUPPLY, MessageId.TEMPERATURE, MessageId.ERROR, MessageId.ADDRESS
        )

    def send_setpoint(self, i: int, mode: JointMode, target: float, limit_nm: float) -> None:
        """Send the setpoint of an axis; before it the limits, and after it gains and mode, if they have changed."""
        axis = self.axes[i]
        if limit_nm != axis.limit_nm:
            self._send_limits(i, limit_nm)
        match mode:
            case JointMode.POSITION:
                self._send(i, MessageId.SET_POSITION, target / REVOLUTION_RAD, 0, 0)
            case JointMode.VELOCITY:
                self._send(i, MessageId.SET_VELOCITY, target / REVOLUTION_RAD, 0.0)
            case JointMode.TORQUE | JointMode.PASSIVE:
                self._send(i, MessageId.SET_TORQUE, target)
        if mode != axis.mode:
            self._send_mode(i, mode)

    def send_command(self, i: int, command: DriveCommand) -> None:
        """Change the state of an axis. An emergency stop is an error that the axis latches."""
        match command:
            case "follow":
                self._send(i, MessageId.SET_STATE, AxisState.CLOSED_LOOP)
            case "idle":
                self._send(i, MessageId.SET_STATE, AxisState.IDLE)
                self.axes[i].mode = None
            case "stop":
                self._send(i, MessageId.ESTOP)
                self.axes[i].mode = None

    def _send_limits(self, i: int, limit_nm: float) -> None:
        """Send the speed and current limits; the axis never gets a higher current than it was configured for."""
        axis = self.axes[i]
        # Assigns `current_soft_max`.
        current_a = min(limit_nm / axis.torque_constant, axis.max_current_a)
        if self._send(i, MessageId.SET_LIMITS, axis.speed_limit, current_a):
            axis.limit_nm = limit_nm

    def _send_mode(self, i: int, mode: JointMode) -> None:
        """Send the gain and the control mode; both again in the next cycle if the bus did not accept one of them."""
        axis = self.axes[i]
        gain = axis.damping if mode == JointMode.POSITION else axis.velocity_gain
        gain_sent = self._send(i, MessageId.SET_VELOCITY_GAINS, gain, 0.0)
        mode_sent = self._send(i, MessageId.SET_MODE, CONTROL_MODES[mode], PASSTHROUGH)
        if gain_sent and mode_sent:
            axis.mode = mode

    def _send(self, i: int, message_id: MessageId, *values: float) -> bool:
        return self.wire.send(encode_message(self.node_ids[i], message_id, *values))

    def _request(self, i: int, *messages: MessageId) -> bool:
        """Send a request for each of these messages. Returns whether the bus accepted all of them."""
        accepted = [
            self.wire.send(encode_request(self.node_ids[i], message_id)) for message_id in messages
        ]
        return all(accepted)


def make_axis(joint: Joint, max_current_a: float) -> OdriveAxis:
    """Create the state of an axis, with the gains and limits of its joint converted to the shaft.

    Args:
        joint: Joint that the axis moves.
        max_current_a: Highest current limit that the driver may send until the axis' own limit is known.
    """
    motor = joint.motor
    gear = joint.drive.gear
    return OdriveAxis(
        torque_constant=motor.torque_constant_nm_per_a or EMULATED_CONSTANT_NM_PER_A,
        position_gain=motor.stiffness_nm_per_rad / motor.damping_nm_s_per_rad,
        damping=motor.damping_nm_s_per_rad / gear**2 * REVOLUTION_RAD,
        velocity_gain=motor.velocity_gain_nm_s_per_rad / gear**2 * REVOLUTION_RAD,
        speed_limit=joint.limits.speed_rad_s * gear / REVOLUTION_RAD,
        torque_nm=joint.limits.torque_nm / gear,
        max_current_a=max_current_a,
    )


def compute_required_current_a(joint: Joint) -> float:
    """Return the motor current in A that a joint's torque limit requires."""
    torque_constant_nm_per_a = joint.motor.torque_constant_nm_per_a or EMULATED_CONSTANT_NM_PER_A
    return joint.limits.torque_nm / joint.drive.gear / torque_constant_nm_per_a


def find_configuration_problems(axis: OdriveAxis, watchdog_s: float) -> Iterator[str]:
    """Yield a text for each setting of an axis that does not suit its joint, with what to do about it.

    Each text is a predicate, such as "has its watchdog off: ...", to be put after the name of the axis. A setting that
    is NaN never suits.

    Args:
        axis: The axis, with the settings that it has reported.
        watchdog_s: Watchdog timeout of the driver's settings.
    """
    configured = axis.configured
    timeout_s = configured[AxisSetting.WATCHDOG_TIMEOUT]
    if not configured[AxisSetting.WATCHDOG_ENABLED]:
        yield f"has its watchdog off: set `enable_watchdog` = True and `watchdog_timeout` = {watchdog_s:g}, and save"
    elif not abs(timeout_s - watchdog_s) <= RELATIVE_TOLERANCE * watchdog_s:
        yield (
            f"has a watchdog of {timeout_s:g} s, but `backends.odrive.watchdog_s` = {watchdog_s:g}: correct "
            f"`watchdog_timeout` and save, or correct the scenario"
        )
    current_a = configured[AxisSetting.CURRENT]
    if not axis.torque_nm / axis.torque_constant <= current_a * (1 + RELATIVE_TOLERANCE):
        yield (
            f"has a current limit (`current_soft_max`) of {current_a:.4g} A, which is "
            f"{current_a * axis.torque_constant:.3g} N·m, and its joint may command {axis.torque_nm:.3g} N·m: raise "
            f"the one, or lower `torque_nm`. If a driver was killed, it may have left a lower limit: restart the axis"
        )
    speed = configured[AxisSetting.SPEED]
    if not axis.speed_limit <= speed * (1 + RELATIVE_TOLERANCE):
        yield (
            f"has a speed limit (`vel_limit`) of {speed:.4g} turns/s, and its joint may turn at "
            f"{axis.speed_limit:.4g}: raise the one, or lower `speed_rad_s`"
        )


def _join_version(numbers: tuple[int, ...]) -> str:
    return ".".join(map(str, numbers))
