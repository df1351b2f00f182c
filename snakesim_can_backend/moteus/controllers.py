"""moteus controllers on one CAN FD bus, as a driver type.

Every setpoint is a complete command in position mode, with the gains of the robot file as fractions of the configured
ones. Velocity mode is a proportional gain of 0, torque mode has both gains 0, and passive is that without torque.
Answers report mode and fault.
"""

import logging
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from snakesim_can_backend.can_drives.drives import HOST, CanDrives, CanDrivesContext
from snakesim_can_backend.moteus.protocol import (
    FAULTS,
    FLOAT,
    HOME_STATE_RELATIVE,
    HOST_ID,
    INT8,
    INT32,
    READ,
    REGISTER_MAP,
    REPLY,
    WRITE,
    MoteusMode,
    Register,
    decode_subframes,
    encode_subframe,
    make_frame,
    split_addresses,
)
from snakesim_can_backend.moteus.settings import MoteusSettings
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_drivers.kit.drive_states import DriveCommand
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.wire.messages import JointMode

REVOLUTION_RAD = 2 * math.pi  # rad
LATCHED_MODES = (MoteusMode.FAULT, MoteusMode.TIMEOUT)  # until a stop, which also clears the reason
NO_LIMIT = -1.0
MODE_UNKNOWN = -1
SERIAL_WORDS = 3  # registers of a serial number
MIN_DIVISOR_V = 1.0  # for power / voltage, when the supply is off

# Subframes of requests.
IDENTITY_REQUESTS = (
    encode_subframe(READ, INT32, Register.MAP_VERSION, count=1),
    encode_subframe(READ, INT8, Register.HOME_STATE, count=1),
)
MOTION_REQUESTS = (
    encode_subframe(READ, FLOAT, Register.MODE, count=4),  # mode, position, velocity, torque
    encode_subframe(READ, INT8, Register.FAULT, count=1),
)
HEALTH_REQUESTS = (
    encode_subframe(READ, FLOAT, Register.POWER, count=1),
    encode_subframe(READ, FLOAT, Register.MOTOR_TEMPERATURE, count=1),
    encode_subframe(READ, FLOAT, Register.VOLTAGE, count=2),  # voltage, board temperature
)
SERIAL = encode_subframe(READ, INT32, Register.SERIAL, count=SERIAL_WORDS)

_log = logging.getLogger("snakesim.moteus")


class ShaftGains(NamedTuple):
    """Gains at a controller's shaft, in turns; or, as fractions of the configured ones, without a unit."""

    stiffness: float  # N·m/turn
    damping: float  # N·m/(turn/s), position mode
    velocity: float  # N·m/(turn/s), velocity mode


class MoteusControllers(CanDrives):
    """All controllers of a bus."""

    missing_identity_text = (
        "does not report its register map: it is off, has another id, or the bus "
        "another bit rate or sample point"
    )

    def __init__(self, context: CanDrivesContext) -> None:
        """Compute the gains that setpoints carry."""
        super().__init__(context)
        kp_nm_per_turn, kd_nm_s_per_turn = get_configured_gains(
            context.all_joints, context.settings
        )
        self._gain_fractions: list[ShaftGains] = []
        for joint in context.joints:
            gains = compute_shaft_gains(joint)
            self._gain_fractions.append(
                ShaftGains(
                    stiffness=gains.stiffness / kp_nm_per_turn,
                    damping=gains.damping / kd_nm_s_per_turn,
                    velocity=gains.velocity / kd_nm_s_per_turn,
                )
            )
        self._watchdog_s: float = context.settings.watchdog_s
        self._modes = [MODE_UNKNOWN] * len(context.joints)
        self._home_states = [HOME_STATE_RELATIVE] * len(context.joints)

    # --- frames that arrive -----------------------------------------------------------------------------------

    def find_sender(self, frame: CanFrame) -> int | None:
        """Return the id of the sender, or None for frames to other nodes.

        Another host has the same id as this one. Its frames are ignored (None) unless they write (`HOST`).
        """
        source, destination = split_addresses(frame)
        if source == HOST_ID:
            first_subframe_writes = frame.data[:1] < bytes([READ])
            return HOST if first_subframe_writes else None
        return source if destination == HOST_ID else None

    def handle_response(self, i: int, frame: CanFrame) -> None:
        """Store the registers of a response. Each request reads other registers, so they identify the response."""
        registers: dict[int, float] = {}
        for subframe in decode_subframes(frame.data):
            if subframe.kind == REPLY:
                for offset, value in enumerate(subframe.values):
                    registers[subframe.register + offset] = value
        if Register.POSITION in registers:
            self._store_motion(i, registers)
        if Register.VOLTAGE in registers:
            self._store_health(i, registers)
        if Register.MAP_VERSION in registers:
            self.firmware[i] = (int(registers[Register.MAP_VERSION]),)
            self._home_states[i] = int(registers[Register.HOME_STATE])
        if Register.SERIAL in registers:
            words = [int(registers[Register.SERIAL + k]) & 0xFFFF_FFFF for k in range(SERIAL_WORDS)]
            self.record_serial(i, "".join(f"{word:08X}" for word in reversed(words)))

    def _store_motion(self, i: int, registers: Mapping[int, float]) -> None:
        mode = int(registers[Register.MODE])
        fault = int(registers[Register.FAULT])
        self._modes[i] = mode
        self.readings.mark_checked(i)
        self.readings.set_motion(
            i,
            registers[Register.POSITION] * REVOLUTION_RAD,
            registers[Register.VELOCITY] * REVOLUTION_RAD,
        )
        self.readings.set_torque(i, registers[Register.TORQUE])
        self.states.record_report(i, enabled=mode == MoteusMode.POSITION, state=f"in mode {mode}")
        self.states.drives[i].errors = describe_fault(mode, fault)

    def _store_health(self, i: int, registers: Mapping[int, float]) -> None:
        voltage_v = registers[Register.VOLTAGE]
        current_a = registers[Register.POWER] / max(voltage_v, MIN_DIVISOR_V)
        self.readings.set_supply(i, voltage_v, current_a)
        self.readings.set_temperatures(
            i, registers[Register.MOTOR_TEMPERATURE], registers[Register.BOARD_TEMPERATURE]
        )

    # --- bring-up, reset and end ------------------------------------------------------------------------------

    def request_identity(self, i: int) -> None:
        """Request the version of the registers, the reference of the position, serial number and mode."""
        self._send(i, *IDENTITY_REQUESTS, reply=True)
        self._send(i, SERIAL, reply=True)
        self.request_motion(i)

    def validate_drive(self, i: int) -> str:
        """Return why the register map or the encoder of a controller cannot be used; empty if both can."""
        if self.firmware[i] != (REGISTER_MAP,):
            return f"has register map {self.firmware[i][0]}; this driver knows {REGISTER_MAP}: update its firmware"
        if self._home_states[i] == HOME_STATE_RELATIVE:
            return "does not know where it is: its position has no reference (home state 0); configure its encoders"
        return ""

    def clear_leftover_errors(self, i: int) -> None:
        """Clear an expired watchdog."""
        if self._modes[i] == MoteusMode.TIMEOUT:
            _log.warning(
                "%s: clearing an expired watchdog of an earlier run", self.states.drives[i].label
            )
            self._send_stop(i)

    def write_settings(self, i: int) -> None:
        """Write nothing: every command is complete."""

    def clear_errors(self, i: int) -> None:
        """Stop a controller, which clears its faults as well."""
        self._send_stop(i)

    def restore_settings(self, i: int) -> None:
        """Write nothing: limits are part of each command."""

    # --- a control cycle --------------------------------------------------------------------------------------

    def request_motion(self, i: int) -> bool:
        """Request mode, position, velocity, torque and fault."""
        return self._send(i, *MOTION_REQUESTS, reply=True)

    def request_health(self, i: int) -> None:
        """Request power, temperatures and voltage; and the serial number, to notice a second drive with this id."""
        self._send(i, *HEALTH_REQUESTS, reply=True)
        self._send(i, SERIAL, reply=True)

    def send_setpoint(self, i: int, mode: JointMode, target: float, limit_nm: float) -> None:
        """Send a command, unless the controller was restarted or may be restarting: a command would enable it.

        The controller adds position, velocity and torque control; what a mode does not use gets a gain of 0.

        Args:
            i: Index of the controller on the bus.
            mode: Control mode of the setpoint.
            target: Target at the shaft in rad, rad/s or N·m, by the mode; 0 for a passive controller.
            limit_nm: Torque limit at the shaft.
        """
        was_restarted = self.states.drives[i].was_enabled and self._modes[i] != MoteusMode.POSITION
        if was_restarted or self.readings.count_unanswered_requests(i):
            return
        gains = self._gain_fractions[i]
        position = math.nan  # stands for the current position of the controller
        velocity = 0.0
        torque = 0.0
        kp = 0.0
        kd = 0.0
        match mode:
            case JointMode.POSITION:
                position = target / REVOLUTION_RAD
                kp = gains.stiffness
                kd = gains.damping
            case JointMode.VELOCITY:
                velocity = target / REVOLUTION_RAD
                kd = gains.velocity
            case JointMode.TORQUE | JointMode.PASSIVE:
                torque = target
        self._send(
            i,
            encode_subframe(WRITE, INT8, Register.MODE, MoteusMode.POSITION),
            encode_subframe(
                WRITE, FLOAT, Register.COMMAND, position, velocity, torque, kp, kd, limit_nm
            ),
            encode_subframe(WRITE, FLOAT, Register.WATCHDOG, self._watchdog_s, NO_LIMIT, NO_LIMIT),
        )

    def send_command(self, i: int, command: DriveCommand) -> None:
        """Stop a controller unless it should follow: a setpoint enables it.

        A controller that has stopped by itself gets no stop, which would clear the reason: that is for the operator.
        """
        if self._modes[i] in LATCHED_MODES:
            return
        match command:
            case "follow":
                return
            case "idle":
                # A controller that may have stopped by itself gets the stop later, once it reports that it is on.
                if i not in self.readings.drives_to_check:
                    self._send_stop(i)
            case "stop":
                self._send_stop(i)

    def _send_stop(self, i: int) -> None:
        self._send(i, encode_subframe(WRITE, INT8, Register.MODE, MoteusMode.STOPPED))

    def _send(self, i: int, *subframes: bytes, reply: bool = False) -> bool:
        return self.wire.send(make_frame(HOST_ID, self.node_ids[i], *subframes, reply=reply))


def describe_fault(mode: int, fault: int) -> str:
    """Return why a controller has stopped by itself; empty if it has not."""
    match mode:
        case MoteusMode.TIMEOUT:
            return "timeout: its watchdog expired"
        case MoteusMode.FAULT:
            return f"fault {fault}, {FAULTS.get(fault, 'see its manual')}"
        case _:
            return ""


def compute_shaft_gains(joint: Joint) -> ShaftGains:
    """Return the gains of a joint at the shaft of its controller."""
    motor = joint.motor
    joint_to_shaft = REVOLUTION_RAD / joint.drive.gear**2
    return ShaftGains(
        stiffness=motor.stiffness_nm_per_rad * joint_to_shaft,
        damping=motor.damping_nm_s_per_rad * joint_to_shaft,
        velocity=motor.velocity_gain_nm_s_per_rad * joint_to_shaft,
    )


def compute_required_gains(joints: Sequence[Joint]) -> tuple[float, float]:
    """Return the lowest `servo.pid_position.kp` and `kd` with which the controllers can drive all joints.

    Setpoints carry gains as fractions of these, and a fraction above 1 is not possible. So they are the maxima over all
    joints, in N·m/turn and N·m/(turn/s).
    """
    gains = [compute_shaft_gains(joint) for joint in joints]
    kp = max(joint_gains.stiffness for joint_gains in gains)
    kd = max(max(joint_gains.damping, joint_gains.velocity) for joint_gains in gains)
    return kp, kd


def get_configured_gains(joints: Sequence[Joint], settings: MoteusSettings) -> tuple[float, float]:
    """Return the `servo.pid_position.kp` and `kd` that the controllers have.

    Args:
        joints: All joints of the driver type.
        settings: The settings of the driver type; gains that they leave out are what the joints need.
    """
    kp, kd = compute_required_gains(joints)
    return settings.kp_nm_per_turn or kp or 1.0, settings.kd_nm_s_per_turn or kd or 1.0
