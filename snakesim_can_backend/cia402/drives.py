"""CiA 402 drives on one CANopen bus, as a driver type.

In every control cycle the host sends one SYNC, which every drive answers with two PDOs: state, position and torque,
then velocity, mode and error code. A setpoint is one PDO with controlword, target and torque limit. With the setpoints
the host sends its heartbeat: a drive that does not receive it for `watchdog_s` stops by itself.
"""

import logging
from functools import partial

from snakesim_can_backend.can_drives.drives import HOST, CanDrives, CanDrivesContext
from snakesim_can_backend.cia402.configuration import (
    list_configuration_steps,
    list_fault_reset_steps,
    list_identification_steps,
    list_switch_off_steps,
)
from snakesim_can_backend.cia402.eds import BUNDLED, find_eds, read_all_eds
from snakesim_can_backend.cia402.frames import (
    DOWNLOAD_REQUEST,
    HEARTBEAT_LOST,
    RECEIVE_PDOS,
    SYNC_ID,
    TRANSMIT_PDOS,
    UPLOAD_RESPONSE,
    EmergencyMessage,
    FunctionCode,
    NmtCommand,
    NmtState,
    SdoFrame,
    decode_emergency,
    decode_sdo,
    describe_error,
    describe_register,
    encode_heartbeat,
    encode_nmt,
    encode_write,
    split_id,
)
from snakesim_can_backend.cia402.limits import MODES, determine_scaling, find_incompatibilities
from snakesim_can_backend.cia402.objects import (
    ABORT_CONNECTION_OPTION_CODE,
    CONSUMER_HEARTBEAT,
    ERROR_CODE,
    MAX_TORQUE,
    MODE_PDO,
    MOTION_PDO,
    POSITION_PDO,
    PRODUCT_CODE,
    REVISION,
    SERIAL,
    STATE_PDO,
    STATUSWORD,
    TORQUE_PDO,
    VELOCITY_PDO,
    VENDOR_ID,
    Pdo,
)
from snakesim_can_backend.cia402.sdo import ReadStep, SdoQueue, SdoStepResult
from snakesim_can_backend.cia402.servo import Cia402Drive, Phase, make_health_objects
from snakesim_can_backend.cia402.state_machine import (
    FAULT_STATES,
    ControlwordCommand,
    PowerState,
    decode_statusword,
)
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_drivers.kit.drive_states import DriveCommand
from snakesim_drivers.kit.drives import BusCommand
from snakesim_drivers.kit.findings import FaultFinding
from snakesim_hal.wire.messages import JointMode

MAX_MISSED_HEARTBEATS = 5  # of a drive that still answers SYNC
MIN_PRE_OPERATIONAL_HEARTBEATS = 2  # one may be from before the start of the drive
# Errors that some drives keep until their communication restarts.
NEEDS_COMMUNICATION_RESET = HEARTBEAT_LOST, 0x8120
# After which a drive that does not complete its start counts as silent.
MAX_START_NS = 1_000_000_000
# After which a drive is configured whose boot-up message has not arrived.
MAX_BOOT_NS = 1_000_000_000

_log = logging.getLogger("snakesim.drivers")


class Cia402Drives(CanDrives):
    """All CiA 402 drives of a bus."""

    missing_identity_text = (
        "does not answer SDO requests: it is off, has another node id or bit rate, or "
        "is no CANopen device"
    )

    def __init__(self, context: CanDrivesContext) -> None:
        """Prepare to drive the drives on an open bus, and read the EDS files that the settings name.

        Args:
            context: The open bus, its joints, the settings, and the timeouts of the driver.

        Raises:
            ConfigError: An EDS file cannot be read, or describes a drive that this driver cannot drive.
        """
        super().__init__(context)
        self._settings = context.settings
        self._joints = context.joints
        self._now_ns = context.clock_ns
        self._period_s = context.cycle_ns * 1e-9
        uses_bundled_eds = self.emulated and not self._settings.eds
        paths = [str(BUNDLED)] if uses_bundled_eds else self._settings.eds
        self._eds = read_all_eds(paths)
        self._health = make_health_objects(self._settings, uses_bundled_eds=uses_bundled_eds)
        self._watchdog_ns = round(self._settings.watchdog_s * 1e9)
        # From the first enabling on, because drives then watch the host.
        self._should_send_heartbeats = False
        self._was_sync_accepted = False
        self.servos = [self._make_servo(i) for i in range(len(context.joints))]

    # --- frames that arrive -----------------------------------------------------------------------------------

    def find_sender(self, frame: CanFrame) -> int | None:
        """Return the node id of the drive that sent a frame.

        Returns:
            The node id; `HOST` if only a host sends such a frame; None if any program may send it, such as an SDO
            request that only reads.
        """
        function_code, node = split_id(frame)
        if node == 0:  # a broadcast
            return HOST if frame.id in (FunctionCode.NMT, SYNC_ID) else None
        if function_code in RECEIVE_PDOS:  # received by the drive (RPDO), so sent by a host
            return HOST
        if function_code in TRANSMIT_PDOS:  # transmitted by the drive (TPDO)
            return node
        match function_code:
            case FunctionCode.EMERGENCY | FunctionCode.SDO_RESPONSE:
                return node
            case FunctionCode.SDO_REQUEST:
                # The upper three bits are the command specifier. Every write starts with an initiate download.
                is_write = bool(frame.data) and frame.data[0] >> 5 == DOWNLOAD_REQUEST
                return HOST if is_write else None
            case FunctionCode.HEARTBEAT:
                return HOST if node == self._settings.host_id else node
            case _:
                return None

    def handle_response(self, i: int, frame: CanFrame) -> None:
        """Store what a drive reports in a PDO, an SDO response, an emergency message or a heartbeat."""
        function, _ = split_id(frame)
        match function:
            case STATE_PDO.base:
                self._handle_state(i, *STATE_PDO.layout.unpack(frame.data))
            case MOTION_PDO.base:
                self._handle_motion(i, *MOTION_PDO.layout.unpack(frame.data))
            case FunctionCode.SDO_RESPONSE:
                self._handle_sdo(i, decode_sdo(frame.data))
            case FunctionCode.EMERGENCY:
                self._handle_emergency(i, decode_emergency(frame.data))
            case FunctionCode.HEARTBEAT:
                self._handle_heartbeat(i, frame.data[0] & 0x7F)
            case _:
                pass

    def _handle_state(self, i: int, statusword: int, position: int, torque: int) -> None:
        servo = self.servos[i]
        if servo.scaling is None:
            return
        servo.position = position
        self.readings.set_torque(i, servo.scaling.to_torque_nm(torque))
        self._store_motion(i)
        self._store_state(i, decode_statusword(statusword))

    def _handle_motion(self, i: int, velocity: int, mode: int, error_code: int) -> None:
        servo = self.servos[i]
        servo.velocity = velocity
        servo.mode = mode
        servo.error_code = error_code
        self._store_motion(i)
        self.states.drives[i].errors = servo.describe_errors()

    def _store_motion(self, i: int) -> None:
        """Store angle and velocity in the readings once both PDOs that answer a SYNC have arrived."""
        servo = self.servos[i]
        if servo.position is None or servo.velocity is None or servo.scaling is None:
            return
        angle_rad = servo.scaling.to_angle_rad(servo.position)
        velocity_rad_s = servo.scaling.to_velocity_rad_s(servo.velocity)
        self.readings.set_motion(i, angle_rad, velocity_rad_s)
        servo.position = None
        servo.velocity = None

    def _store_state(self, i: int, state: PowerState) -> None:
        servo = self.servos[i]
        servo.state = state
        self.readings.mark_checked(i)
        if state == PowerState.ENABLED and servo.is_enabling:
            servo.is_enabling = False
            servo.was_enabled = True
        if state not in FAULT_STATES:
            servo.emergency = None
        self.states.record_report(
            i, enabled=state == PowerState.ENABLED, state=f"in the state {state.value!r}"
        )
        self.states.drives[i].errors = servo.describe_errors()
        self._disable_after_quick_stop(i)

    def _disable_after_quick_stop(self, i: int) -> None:
        """Switch a drive off that brakes for longer than a watchdog's time, or holds its position after a stop."""
        servo = self.servos[i]
        if servo.state != PowerState.QUICK_STOP:
            servo.quick_stop_start_ns = None
            return
        now_ns = self._now_ns()
        if servo.quick_stop_start_ns is None:
            servo.quick_stop_start_ns = now_ns
        elif now_ns - servo.quick_stop_start_ns > self._watchdog_ns:
            self._send_disable(i, ControlwordCommand.DISABLE_VOLTAGE)

    def _handle_emergency(self, i: int, emergency: EmergencyMessage) -> None:
        servo = self.servos[i]
        if emergency.code >> 8 == 0:  # the error is gone
            servo.emergency = None
        else:
            servo.emergency = emergency
            label = self.states.drives[i].label
            _log.warning(
                "%s: %s; %s",
                label,
                describe_error(emergency.code),
                describe_register(emergency.register),
            )
        self.states.drives[i].errors = servo.describe_errors()

    def _handle_heartbeat(self, i: int, nmt_state: int) -> None:
        """Configure a drive that has restarted, or that has left the NMT state operational. It stays off."""
        servo = self.servos[i]
        servo.last_heartbeat_ns = self._now_ns()
        if nmt_state == NmtState.BOOT_UP:
            if servo.phase != "unknown":
                self._configure(i)
            return
        if servo.phase != "ready" or nmt_state == NmtState.OPERATIONAL:
            servo.pre_operational_heartbeats = 0
            return
        servo.pre_operational_heartbeats += 1
        if servo.pre_operational_heartbeats >= MIN_PRE_OPERATIONAL_HEARTBEATS:
            self._configure(i)

    # --- SDO --------------------------------------------------------------------------------------------------

    def _make_servo(self, i: int) -> Cia402Drive:
        queue = SdoQueue(
            send_request=partial(self._send_sdo, i),
            send_nmt=partial(self._send_nmt, i),
            on_result=partial(self._store_result, i),
            now_ns=self._now_ns,
        )
        return Cia402Drive(queue)

    def _send_sdo(self, i: int, data: bytes) -> None:
        self.wire.send(CanFrame(FunctionCode.SDO_REQUEST | self.node_ids[i], data))

    def _send_nmt(self, i: int, command: NmtCommand) -> None:
        self.wire.send(encode_nmt(command, self.node_ids[i]))
        if command != NmtCommand.START:
            return
        servo = self.servos[i]
        self._enter_phase(servo, "ready")
        servo.last_heartbeat_ns = self._now_ns()
        servo.pre_operational_heartbeats = 0
        is_last_of_bring_up = all(
            other.phase == "ready" for other in self.servos
        ) and not self.readings.has_reported(i)
        if is_last_of_bring_up:
            self._send_sync()  # so that bring-up need not wait for its next requests

    def _handle_sdo(self, i: int, response: SdoFrame) -> None:
        is_serial = (response.index, response.sub) == (SERIAL.index, SERIAL.sub)
        if is_serial and response.kind == UPLOAD_RESPONSE:
            self._record_identity(i, SERIAL.decode(response.data))
        self.servos[i].queue.handle_response(response)

    def _record_identity(self, i: int, serial: int) -> None:
        """Store vendor, product and serial number of a drive; a serial number of 0 means that the drive has none."""
        values = self.servos[i].values
        if serial and VENDOR_ID in values:
            self.record_serial(
                i, f"{values[VENDOR_ID]:08X}-{values.get(PRODUCT_CODE, 0):08X}-{serial:08X}"
            )

    def _store_result(self, i: int, result: SdoStepResult) -> None:
        servo = self.servos[i]
        match servo.phase:
            case "unknown":
                self._store_identity(i, result)
            case "ready":
                self._store_health(i, result)
            case "booting" | "configuring" if result.failure:
                servo.failure = result.failure
                servo.queue.clear()
                self.states.drives[i].errors = servo.describe_errors()
            case _:
                pass

    def _store_identity(self, i: int, result: SdoStepResult) -> None:
        servo = self.servos[i]
        servo.failure = servo.failure or result.failure
        servo.unread_entries.discard(result.step.entry)
        if result.value is not None:
            servo.values[result.step.entry] = result.value
        if not servo.unread_entries:
            revision = servo.values.get(REVISION, 0)
            self.firmware[i] = (revision >> 16, revision & 0xFFFF)
            self.readings.set_identity(i, firmware=f"{revision >> 16}.{revision & 0xFFFF}")

    def _store_health(self, i: int, result: SdoStepResult) -> None:
        """Store a value of a drive's health; after the last one, store all values in the readings."""
        servo = self.servos[i]
        entry = result.step.entry
        if result.value is not None:
            servo.health[entry] = result.value
        if entry != self._health.entries[-1]:
            return
        health = self._health.convert(servo)
        servo.health = {}
        if health is not None:
            self.readings.set_supply(i, health.voltage_v, health.current_a)
            self.readings.set_temperatures(i, health.motor_c, health.board_c)

    # --- bring-up, reset and end ------------------------------------------------------------------------------

    def request_identity(self, i: int) -> None:
        """Read identity, limits and units, one entry after the other."""
        servo = self.servos[i]
        if not servo.unread_entries and not self.firmware[i]:
            steps = list_identification_steps()
            servo.unread_entries = {step.entry for step in steps}
            servo.queue.add(steps)
        servo.queue.repeat_late_request()

    def forget_identities(self) -> None:
        """Forget everything that drives have reported."""
        super().forget_identities()
        self.servos = [self._make_servo(i) for i in range(len(self.node_ids))]

    def validate_drive(self, i: int) -> str:
        """Check EDS, identity, modes, units and limits of a drive, and store its scaling.

        Args:
            i: Index of the drive on the bus, whose identity, limits and units have been read.

        Returns:
            The reasons why the drive cannot be used, as one text; an empty string if it can be used.
        """
        servo = self.servos[i]
        if servo.failure:
            return servo.failure
        joint = self._joints[i]
        vendor = servo.values[VENDOR_ID]
        product = servo.values.get(PRODUCT_CODE, 0)  # unlike the vendor, this entry is optional
        if self._eds and find_eds(self._eds, vendor, product) is None:
            files = ", ".join(f"0x{file.vendor:X} and 0x{file.product:X}" for file in self._eds)
            return (
                f"has vendor 0x{vendor:X} and product 0x{product:X}, and `backends.cia402.eds` names files of {files}: "
                f"add the EDS of this drive"
            )
        scaling = determine_scaling(servo.values, self._settings, joint)
        if isinstance(scaling, str):
            return scaling
        servo.scaling = scaling
        problems = list(find_incompatibilities(servo.values, scaling, self._settings, joint))
        if (
            ABORT_CONNECTION_OPTION_CODE not in servo.values
            and not self._settings.allow_unverified_watchdog
        ):
            problems.append(
                f"has no {ABORT_CONNECTION_OPTION_CODE.name} ({ABORT_CONNECTION_OPTION_CODE.address}), so it cannot "
                "be verified that it stops when the host is silent: test it, and set "
                "`backends.cia402.allow_unverified_watchdog`"
            )
        return "; ".join(problems)

    def find_start_up_problem(self, i: int) -> str:
        """Return why a drive could not be configured; empty if it could, or if that is not known yet."""
        failure = self.servos[i].failure
        return f"cannot be configured: {failure}" if failure else ""

    def clear_leftover_errors(self, i: int) -> None:
        """Clear a lost heartbeat of an earlier run, if that is the error."""
        servo = self.servos[i]
        state = decode_statusword(servo.values[STATUSWORD])
        if state == PowerState.FAULT and servo.values.get(ERROR_CODE) == HEARTBEAT_LOST:
            _log.warning(
                "%s: clearing an expired watchdog of an earlier run", self.states.drives[i].label
            )
            self._restart_communication(i)

    def write_settings(self, i: int) -> None:
        """Configure a drive, unless it is configured or is about to be."""
        servo = self.servos[i]
        if servo.phase == "unknown" or servo.failure:
            self._configure(i)

    def clear_errors(self, i: int) -> None:
        """Reset the fault of a drive. One that is silent keeps it: the reset might arrive much later."""
        servo = self.servos[i]
        if servo.phase != "ready" or self.readings.count_unanswered_requests(i):
            return
        if servo.error_code in NEEDS_COMMUNICATION_RESET:
            self._restart_communication(i)
        elif servo.state in FAULT_STATES:
            servo.queue.add(list_fault_reset_steps())

    def restore_settings(self, i: int) -> None:
        """End the drive's watch of the host, which is about to be silent. Torque limits are restored by "idle"."""
        if self.servos[i].phase == "ready":
            self._send_sdo(i, encode_write(CONSUMER_HEARTBEAT, 0))

    def _restart_communication(self, i: int) -> None:
        """Restart the communication of a drive; its boot-up message leads to its configuration and fault reset."""
        servo = self.servos[i]
        servo.queue.clear()
        servo.should_reset_fault = True
        self._enter_phase(servo, "booting")
        self._send_nmt(i, NmtCommand.RESET_COMMUNICATION)

    def _configure(self, i: int) -> None:
        """Switch a drive off, and write all that it needs for control cycles."""
        servo = self.servos[i]
        servo.failure = ""
        servo.is_enabling = False
        self._enter_phase(servo, "configuring")
        servo.queue.clear()
        servo.queue.add(
            list_fault_reset_steps() if servo.should_reset_fault else list_switch_off_steps()
        )
        servo.queue.add(list_configuration_steps(self.node_ids[i], self._settings, self._period_s))
        servo.should_reset_fault = False

    def _enter_phase(self, servo: Cia402Drive, phase: Phase) -> None:
        servo.phase = phase
        servo.phase_start_ns = self._now_ns()

    # --- a control cycle --------------------------------------------------------------------------------------

    def request_motion(self, i: int) -> bool:
        """Send one SYNC for all drives, and repeat SDO requests that were not answered.

        Returns:
            Whether the bus accepted the SYNC, and the drive can answer it: one that is being configured cannot.
        """
        servo = self.servos[i]
        if i == 0:
            self._send_sync()
        servo.queue.repeat_late_request()
        if servo.phase == "booting" and self._now_ns() - servo.phase_start_ns > MAX_BOOT_NS:
            self._configure(i)
        return self._was_sync_accepted and not self._is_configuring(servo)

    def is_awaiting_responses(self) -> bool:
        """Return whether a drive is being configured: it takes many answers."""
        return any(
            self._is_configuring(servo) and servo.queue.is_awaiting_response
            for servo in self.servos
        )

    def request_health(self, i: int) -> None:
        """Read voltage, current and temperatures; and the serial number, to notice a second drive with this id."""
        servo = self.servos[i]
        if servo.phase == "ready" and servo.queue.is_idle:
            entries = [SERIAL, *self._health.entries]
            servo.queue.add(ReadStep(entry, optional=True) for entry in entries)

    def send_setpoints(self, command: BusCommand) -> None:
        """Send setpoints and commands, and with them the heartbeat that the drives watch."""
        if command.enabled_drives and command.may_enable:
            self._should_send_heartbeats = True
        if self._should_send_heartbeats:
            self.wire.send(encode_heartbeat(self._settings.host_id, NmtState.OPERATIONAL))
        super().send_setpoints(command)

    def send_setpoint(self, i: int, mode: JointMode, target: float, limit_nm: float) -> None:
        """Send a setpoint, with the controlword that leads the drive one step towards Operation enabled.

        Nothing is sent to a drive that is not configured. A drive that has left Operation enabled by itself gets the
        command that keeps it off.

        Args:
            i: Index of the drive on the bus.
            mode: Control mode of the setpoint.
            target: Target at the shaft in rad, rad/s or N·m, by the mode; 0 for a passive drive.
            limit_nm: Torque limit at the shaft.
        """
        servo = self.servos[i]
        scaling = servo.scaling
        if servo.phase != "ready" or scaling is None:
            return
        target_mode = MODES[mode]
        control = servo.choose_controlword(target_mode)
        max_torque = min(scaling.to_max_torque(limit_nm), servo.values[MAX_TORQUE])
        match mode:
            case JointMode.POSITION:
                self._send_pdo(i, POSITION_PDO, control, scaling.to_position(target), max_torque)
            case JointMode.VELOCITY:
                self._send_pdo(i, VELOCITY_PDO, control, scaling.to_velocity(target), max_torque)
            case JointMode.TORQUE | JointMode.PASSIVE:
                self._send_pdo(i, TORQUE_PDO, control, scaling.to_torque(target), max_torque)
        if servo.mode != target_mode:
            self._send_pdo(i, MODE_PDO, target_mode)

    def send_command(self, i: int, command: DriveCommand) -> None:
        """Start to enable a drive, switch it off, or stop it by its quick stop."""
        servo = self.servos[i]
        if command == "follow":  # the next setpoints carry the commands
            servo.is_enabling = not servo.was_enabled
            return
        servo.is_enabling = False
        servo.was_enabled = False
        match command:
            case "idle":
                self._send_disable(i, ControlwordCommand.DISABLE_VOLTAGE)
            case "stop":
                self._send_disable(i, ControlwordCommand.QUICK_STOP)

    def list_findings(self) -> list[FaultFinding]:
        """Return what is wrong, including drives that answer SYNC but have stopped to send heartbeats."""
        findings = super().list_findings()
        timeout_ns = MAX_MISSED_HEARTBEATS * self._settings.heartbeat_s * 1e9
        for i, servo in enumerate(self.servos):
            if servo.phase != "ready" or self.readings.count_unanswered_requests(i):
                # A silent drive has a finding of its own; count from its next response on.
                servo.last_heartbeat_ns = self._now_ns()
            age_ns = self._now_ns() - servo.last_heartbeat_ns
            if age_ns > timeout_ns:
                cause = (
                    f"{self.states.drives[i].label} answers SYNC, but has sent no heartbeat for "
                    f"{age_ns * 1e-6:.0f} ms"
                )
                findings.append(FaultFinding("drive_silent", cause, i, affects_only_joint=True))
        return findings

    def _is_configuring(self, servo: Cia402Drive) -> bool:
        """Return whether a drive is booting or being configured, and its time limit for that is not exceeded."""
        is_due = servo.phase in ("booting", "configuring") and not servo.failure
        return is_due and self._now_ns() - servo.phase_start_ns <= MAX_START_NS

    def _send_sync(self) -> None:
        for servo in self.servos:
            servo.position = None
            servo.velocity = None
        self._was_sync_accepted = self.wire.send(CanFrame(SYNC_ID, b""))

    def _send_disable(self, i: int, control: ControlwordCommand) -> None:
        """Send a command that ends motion, with no torque, and with the torque limit that the drive had before."""
        servo = self.servos[i]
        if servo.phase == "ready":
            self._send_pdo(i, TORQUE_PDO, control, 0, servo.values[MAX_TORQUE])

    def _send_pdo(self, i: int, pdo: Pdo, *values: int) -> None:
        self.wire.send(CanFrame(pdo.base | self.node_ids[i], pdo.layout.pack(*values)))
