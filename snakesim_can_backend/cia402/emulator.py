"""Emulated CiA 402 drives: objects, state machine, PDOs, heartbeats and emergency messages, on a simulated body.

They do *not* simulate segmented and block transfers, storing of parameters, homing, profile and interpolated modes,
ramps of a shutdown and of a fault reaction, the tuning of real position and velocity loops, arbitration and bit rate.
"""

import math
from dataclasses import dataclass, field

from snakesim_can_backend.can_drives.emulator import CanEmulator, CanEmulatorContext
from snakesim_can_backend.cia402.eds import BUNDLED, read_eds
from snakesim_can_backend.cia402.frames import (
    HEARTBEAT_LOST,
    RECEIVE_PDOS,
    SYNC_ID,
    UPLOAD_RESPONSE,
    EmergencyMessage,
    FunctionCode,
    NmtCommand,
    NmtState,
    decode_sdo,
    encode_emergency,
    encode_heartbeat,
    encode_read_response,
    split_id,
)
from snakesim_can_backend.cia402.limits import (
    REVOLUTION_RAD,
    THOUSANDTHS,
    UnitScaling,
    compute_shaft_range_rad,
)
from snakesim_can_backend.cia402.node import Address, Cia402Node
from snakesim_can_backend.cia402.objects import (
    ABORT_CONNECTION_OPTION_CODE,
    CONSUMER_HEARTBEAT,
    CONTROLWORD,
    CURRENT,
    ENCODER_INCREMENTS,
    ENCODER_REVOLUTIONS,
    ERROR_BEHAVIOR,
    ERROR_CODE,
    ERROR_REGISTER,
    MAX_POSITION,
    MAX_SPEED,
    MAX_TORQUE,
    MIN_POSITION,
    MODE,
    MODE_DISPLAY,
    POSITION,
    PRODUCER_HEARTBEAT,
    PRODUCT_CODE,
    QUICK_STOP_OPTION,
    RATED_CURRENT,
    RATED_TORQUE,
    REVISION,
    SERIAL,
    STATUSWORD,
    TARGET_POSITION,
    TARGET_TORQUE,
    TARGET_VELOCITY,
    TORQUE,
    VELOCITY,
    VENDOR_ID,
    VOLTAGE,
    ObjectEntry,
)
from snakesim_can_backend.cia402.servo import EMULATED_BOARD_TEMPERATURE, EMULATED_MOTOR_TEMPERATURE
from snakesim_can_backend.cia402.settings import Cia402Settings, MountedCia402
from snakesim_can_backend.cia402.state_machine import (
    FAULT_STATES,
    OperationMode,
    PowerState,
    apply_controlword,
    encode_statusword,
)
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.wire.messages import JointMode

BROADCAST = 0  # the node of NMT commands to all nodes, SYNC and heartbeats
COUNTS_PER_TURN = 65_536  # of the encoder
EMULATED_CONSTANT_NM_PER_A = 1.0  # torque constant of drives whose robot file names none
POSITION_MARGIN = 0.02  # of a joint's range: how far the position limits of a drive are beyond it
EMULATED_REVISION = 0x0001_0000
FIRST_SERIAL = 0x4020_0001
# In which the serial number of a second drive with the same id differs.
DUPLICATE_SERIAL_BITS = 0x0100_0000
OVER_TEMPERATURE = EmergencyMessage(0x4210, 0x09)  # generic and temperature
NO_HEARTBEAT = EmergencyMessage(HEARTBEAT_LOST, 0x11)  # generic and communication
STAYS_IN_QUICK_STOP = 5  # from this option code on
AT_REST_SPEED_RAD_S = 0.05  # shaft speed at which a quick stop ends
TORQUE_OFF = 0  # quick stop option code
DRIVE_MODES: dict[int, JointMode] = {
    OperationMode.CYCLIC_POSITION: JointMode.POSITION,
    OperationMode.CYCLIC_VELOCITY: JointMode.VELOCITY,
    OperationMode.CYCLIC_TORQUE: JointMode.TORQUE,
}


@dataclass
class EmulatedCia402Drive:
    """One drive: its objects, and its state."""

    node_id: int  # id
    objects: Cia402Node
    scaling: UnitScaling
    state: PowerState = PowerState.SWITCH_ON_DISABLED
    controlword: int = 0
    error: EmergencyMessage | None = None  # that led to the fault
    is_booting: bool = True
    last_heartbeat_us: float = -math.inf  # when it sent one last
    # When it received one last; None: none since the start.
    last_host_heartbeat_us: float | None = None
    # In its nonvolatile memory.
    saved_values: dict[ObjectEntry, int] = field(default_factory=dict[ObjectEntry, int])


class EmulatedCia402(CanEmulator):
    """All drives of a driver type."""

    broadcast_id = BROADCAST

    def __init__(self, context: CanEmulatorContext) -> None:
        """Create one emulated drive for each joint, with the objects of the first EDS file of the settings."""
        super().__init__(context)
        self._settings: Cia402Settings = context.settings
        paths = self._settings.eds or [str(BUNDLED)]
        self._eds = read_eds(paths[0])
        self._joints = context.joints
        self.drives = [self._make_drive(i) for i in range(len(context.joints))]
        self.on_step(0.0)

    def find_destination_node(self, frame: CanFrame) -> int:
        """Return the node that a frame is for; all nodes receive NMT commands to all, SYNC and heartbeats."""
        function, node = split_id(frame)
        if frame.id == FunctionCode.NMT:
            return frame.data[1]
        if function in RECEIVE_PDOS or function == FunctionCode.SDO_REQUEST:
            return node
        return BROADCAST

    def duplicate_frame(self, frame: CanFrame) -> CanFrame:
        """Return the frame of a second drive: it has another serial number."""
        function, _ = split_id(frame)
        if function != FunctionCode.SDO_RESPONSE:
            return frame
        response = decode_sdo(frame.data)
        if response.kind != UPLOAD_RESPONSE or (response.index, response.sub) != (
            SERIAL.index,
            SERIAL.sub,
        ):
            return frame
        serial = SERIAL.decode(response.data) ^ DUPLICATE_SERIAL_BITS
        return CanFrame(
            frame.id, encode_read_response(response.index, response.sub, SERIAL.encode(serial))
        )

    def restart(self, i: int) -> None:
        """Restart a drive: it loses all settings that it has not saved, and sends its boot-up message later."""
        node = self.drives[i].node_id
        self.drives[i] = self._make_drive(i)
        self.drives[i].node_id = node
        self._drive_motor(i)

    def handle_frame(self, i: int, frame: CanFrame) -> None:
        """Handle a frame that a drive receives: SYNC, NMT command, SDO request, heartbeat of the host, or PDO.

        A drive that is booting ignores all frames.

        Args:
            i: Index of the drive.
            frame: Frame for this drive, or for all nodes.
        """
        drive = self.drives[i]
        function, node = split_id(frame)
        if drive.is_booting:
            return
        if frame.id == SYNC_ID:
            for cob_id, data in drive.objects.list_synchronous_pdos():
                self.send_frame(i, CanFrame(cob_id & ~0x7F | drive.node_id, data))
        elif frame.id == FunctionCode.NMT:
            self._execute_nmt_command(i, frame.data[0])
        elif function == FunctionCode.SDO_REQUEST:
            response = drive.objects.handle_sdo_request(decode_sdo(frame.data))
            self.send_frame(i, CanFrame(FunctionCode.SDO_RESPONSE | drive.node_id, response))
        elif function == FunctionCode.HEARTBEAT:
            if node == self._get_consumer_heartbeat(drive)[0]:
                drive.last_host_heartbeat_us = self.body.now_us
        elif function in RECEIVE_PDOS:
            self._receive_pdo(i, frame)

    def list_enabled(self) -> list[bool]:
        return [drive.state in (PowerState.ENABLED, PowerState.QUICK_STOP) for drive in self.drives]

    def on_step(self, now_us: float) -> None:
        """Let drives boot, watch the host, stop when they are too hot, and send heartbeats."""
        for i, drive in enumerate(self.drives):
            if self.body.is_booting(i):
                continue
            if drive.is_booting:
                drive.is_booting = False
                drive.last_heartbeat_us = now_us
                self.send_frame(i, encode_heartbeat(drive.node_id, NmtState.BOOT_UP))
            self._check_host_heartbeat(i, now_us)
            if self.body.is_too_hot(i) and drive.state not in FAULT_STATES:
                self._fail(i, OVER_TEMPERATURE)
            self._end_quick_stop(i)
            period_us = drive.objects.get(_get_address(PRODUCER_HEARTBEAT)) * 1000
            if period_us and now_us - drive.last_heartbeat_us >= period_us:
                drive.last_heartbeat_us = now_us
                self.send_frame(i, encode_heartbeat(drive.node_id, drive.objects.nmt_state))

    # --- what happens to a drive ------------------------------------------------------------------------------

    def _make_drive(self, i: int) -> EmulatedCia402Drive:
        """Create a drive as it is after power-on: its object dictionary has the defaults of the EDS and saved values.

        Args:
            i: Index of the drive.
        """
        joint = self._joints[i]
        node = Cia402Node(
            eds=self._eds,
            node_id=self.body.joints[i].id,
            on_write=lambda address, value: self._handle_write(i, address, value),
            compute_live_value=lambda address: self._compute_live_value(i, address),
        )
        mounted = self._settings.mounted.get(joint.name, MountedCia402())
        rated_torque_mnm = max(math.ceil(joint.limits.torque_nm / joint.drive.gear * 1000), 1)
        if self._settings.rated_torque_nm is not None:
            rated_torque_mnm = max(round(self._settings.rated_torque_nm * 1000), 1)
        counts = round(self._settings.counts_per_turn or COUNTS_PER_TURN)
        scaling = UnitScaling(
            counts, self._settings.velocity_units_per_turn_s or counts, rated_torque_mnm / 1000
        )
        saved_values = make_saved_values(
            joint, mounted, scaling, self._settings.max_speed_units_per_turn_s
        )
        saved_values |= {
            VENDOR_ID: self._eds.vendor,
            PRODUCT_CODE: self._eds.product,
            REVISION: EMULATED_REVISION,
            SERIAL: FIRST_SERIAL + i,
        }
        for entry, value in saved_values.items():
            if _get_address(entry) in node.values:
                node.values[_get_address(entry)] = int.from_bytes(entry.encode(value), "little")
        return EmulatedCia402Drive(node.node_id, node, scaling, saved_values=saved_values)

    def _execute_nmt_command(self, i: int, command: int) -> None:
        drive = self.drives[i]
        if not drive.objects.apply_nmt(command):
            return
        if command == NmtCommand.RESET_NODE:
            self.restart(i)
            return
        drive.objects.reset_communication()
        for entry in (VENDOR_ID, PRODUCT_CODE, REVISION, SERIAL):
            drive.objects.values[_get_address(entry)] = drive.saved_values[entry]
        drive.objects.nmt_state = NmtState.PRE_OPERATIONAL
        drive.last_host_heartbeat_us = None
        self.send_frame(i, encode_heartbeat(drive.node_id, NmtState.BOOT_UP))

    def _receive_pdo(self, i: int, frame: CanFrame) -> None:
        drive = self.drives[i]
        for address, value in drive.objects.unpack_received_pdo(frame.id, frame.data) or []:
            drive.objects.values[address] = value
            self._handle_write(i, address, value)
        self._drive_motor(i)

    def _handle_write(self, i: int, address: Address, value: int) -> None:
        """Apply the effect of a value that a host has written, such as a controlword."""
        drive = self.drives[i]
        if address == _get_address(CONTROLWORD):
            was_fault = drive.state == PowerState.FAULT
            drive.state = apply_controlword(drive.state, value, drive.controlword)
            drive.controlword = value
            if was_fault and drive.state != PowerState.FAULT:
                drive.error = None
                self.send_frame(i, encode_emergency(drive.node_id, EmergencyMessage(0, 0)))
        elif address == _get_address(CONSUMER_HEARTBEAT):
            drive.last_host_heartbeat_us = None  # the watch begins with the next heartbeat
        self._end_quick_stop(i)
        self._drive_motor(i)

    def _check_host_heartbeat(self, i: int, now_us: float) -> None:
        drive = self.drives[i]
        _, timeout_ms = self._get_consumer_heartbeat(drive)
        if not timeout_ms or drive.last_host_heartbeat_us is None:
            return
        if now_us - drive.last_host_heartbeat_us <= timeout_ms * 1000:
            return
        drive.last_host_heartbeat_us = None
        if not drive.objects.get(_get_address(ERROR_BEHAVIOR)):
            drive.objects.nmt_state = NmtState.PRE_OPERATIONAL
        if (
            drive.objects.get(_get_address(ABORT_CONNECTION_OPTION_CODE))
            and drive.state not in FAULT_STATES
        ):
            self._fail(i, NO_HEARTBEAT)

    def _get_consumer_heartbeat(self, drive: EmulatedCia402Drive) -> tuple[int, int]:
        """Return the node whose heartbeats a drive monitors, and the timeout in ms; 0 if it does not monitor them."""
        value = drive.objects.get(_get_address(CONSUMER_HEARTBEAT))
        return value >> 16 & 0x7F, value & 0xFFFF

    def _fail(self, i: int, error: EmergencyMessage) -> None:
        drive = self.drives[i]
        drive.state = PowerState.FAULT
        drive.error = error
        self.send_frame(i, encode_emergency(drive.node_id, error))
        self._drive_motor(i)

    def _end_quick_stop(self, i: int) -> None:
        """Switch a drive off at the end of a quick stop, unless its option code lets it stay in it."""
        drive = self.drives[i]
        if drive.state != PowerState.QUICK_STOP:
            return
        option = drive.objects.get(_get_address(QUICK_STOP_OPTION))
        is_at_rest = abs(self.body.read_shaft(i).velocity_rad_s) < AT_REST_SPEED_RAD_S
        if option == TORQUE_OFF or (option < STAYS_IN_QUICK_STOP and is_at_rest):
            drive.state = PowerState.SWITCH_ON_DISABLED
            self._drive_motor(i)

    # --- what a drive measures and does -----------------------------------------------------------------------

    def _compute_live_value(self, i: int, address: Address) -> int | None:
        """Return the current value of an object that changes by itself, such as a measurement.

        Args:
            i: Index of the drive.
            address: Index and subindex of the object.

        Returns:
            The value in the units of the drive; None if the object does not change by itself.
        """
        drive = self.drives[i]
        match address:
            case (STATUSWORD.index, 0):
                return encode_statusword(drive.state)
            case (MODE_DISPLAY.index, 0):
                return drive.objects.values.get(_get_address(MODE), 0)
            case (ERROR_CODE.index, 0):
                return 0 if drive.error is None else drive.error.code
            case (ERROR_REGISTER.index, 0):
                return 0 if drive.error is None else drive.error.register
            case (POSITION.index, 0):
                return drive.scaling.to_position(self.body.read_shaft(i).angle_rad)
            case (VELOCITY.index, 0):
                return drive.scaling.to_velocity(self.body.read_shaft(i).velocity_rad_s)
            case (TORQUE.index, 0) | (CURRENT.index, 0):
                return drive.scaling.to_torque(self.body.read_shaft(i).torque_nm)
            case (VOLTAGE.index, 0):
                return round(self.body.read_supply(i)[0] * 1000)
            case (EMULATED_MOTOR_TEMPERATURE.index, EMULATED_MOTOR_TEMPERATURE.sub):
                return round(self.body.read_temperatures(i)[0] * 10)
            case (EMULATED_BOARD_TEMPERATURE.index, EMULATED_BOARD_TEMPERATURE.sub):
                return round(self.body.read_temperatures(i)[1] * 10)
            case _:
                return None

    def _drive_motor(self, i: int) -> None:
        """Apply state, mode and target of a drive to its motor.

        The motor is passive unless operation is enabled, or a quick stop brakes it to a velocity of 0.

        Args:
            i: Index of the drive.
        """
        drive = self.drives[i]
        joint = self._joints[i]
        gear = joint.drive.gear
        scaling = drive.scaling
        mode = JointMode.PASSIVE
        target = 0.0
        match drive.state:
            case PowerState.ENABLED:
                mode = DRIVE_MODES.get(_read_signed(drive, MODE), JointMode.PASSIVE)
                target = self._read_target(drive, mode)
            case PowerState.QUICK_STOP:
                mode = JointMode.VELOCITY
            case _:
                pass
        damping = joint.motor.damping_nm_s_per_rad
        if mode == JointMode.VELOCITY:
            damping = joint.motor.velocity_gain_nm_s_per_rad
        max_speed = drive.objects.get(_get_address(MAX_SPEED))
        self.body.drive_motor(
            i,
            mode,
            target,
            limit_nm=scaling.to_torque_nm(drive.objects.get(_get_address(MAX_TORQUE))),
            stiffness=joint.motor.stiffness_nm_per_rad / gear**2,
            damping=damping / gear**2,
            speed_rad_s=max_speed / self._settings.max_speed_units_per_turn_s * REVOLUTION_RAD,
        )

    def _read_target(self, drive: EmulatedCia402Drive, mode: JointMode) -> float:
        """Return the target of a mode in rad, rad/s or N·m. Positions end at the software position limits."""
        match mode:
            case JointMode.POSITION:
                position = _read_signed(drive, TARGET_POSITION)
                low = _read_signed(drive, MIN_POSITION)
                high = _read_signed(drive, MAX_POSITION)
                if low < high:
                    position = min(max(position, low), high)
                return drive.scaling.to_angle_rad(position)
            case JointMode.VELOCITY:
                return drive.scaling.to_velocity_rad_s(_read_signed(drive, TARGET_VELOCITY))
            case JointMode.TORQUE:
                return drive.scaling.to_torque_nm(_read_signed(drive, TARGET_TORQUE))
            case _:
                return 0.0


def make_saved_values(
    joint: Joint, mounted: MountedCia402, scaling: UnitScaling, max_speed_units_per_turn_s: float
) -> dict[ObjectEntry, int]:
    """Return the values in the nonvolatile memory of a drive: what its joint needs, unless `mounted` overrides it.

    Args:
        joint: Joint as the robot file describes it.
        mounted: Overrides for an emulated drive that is configured otherwise.
        scaling: Units of the drive.
        max_speed_units_per_turn_s: Units of the drive's speed limit for one turn/s.
    """
    gear = joint.drive.gear
    rated_current_a = scaling.rated_torque_nm / (
        joint.motor.torque_constant_nm_per_a or EMULATED_CONSTANT_NM_PER_A
    )
    max_torque_nm = mounted.max_torque_nm or joint.limits.torque_nm / gear
    max_speed_rad_s = mounted.max_speed_rad_s or joint.limits.speed_rad_s * gear
    lower_rad, upper_rad = compute_shaft_range_rad(joint)
    margin_rad = POSITION_MARGIN * (upper_rad - lower_rad)
    min_position = mounted.min_position
    if min_position is None:
        min_position = scaling.to_position(lower_rad - margin_rad)
    max_position = mounted.max_position
    if max_position is None:
        max_position = scaling.to_position(upper_rad + margin_rad)
    return {
        ENCODER_INCREMENTS: round(scaling.counts_per_turn),
        ENCODER_REVOLUTIONS: 1,
        RATED_TORQUE: round(scaling.rated_torque_nm * 1000),
        RATED_CURRENT: round(rated_current_a * 1000),
        MAX_TORQUE: math.ceil(max_torque_nm / scaling.rated_torque_nm * THOUSANDTHS - 1e-6),
        MAX_SPEED: math.ceil(max_speed_rad_s / REVOLUTION_RAD * max_speed_units_per_turn_s - 1e-6),
        MIN_POSITION: min_position,
        MAX_POSITION: max_position,
    }


def _get_address(entry: ObjectEntry) -> Address:
    return entry.index, entry.sub


def _read_signed(drive: EmulatedCia402Drive, entry: ObjectEntry) -> int:
    return entry.decode(drive.objects.get(_get_address(entry)).to_bytes(entry.size, "little"))
