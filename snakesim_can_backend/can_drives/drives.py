"""Drives on one CAN bus: everything of `snakesim_drivers.kit.drives.Drives` except the protocol of a driver type.

A driver type subclasses `CanDrives` and implements its abstract methods. In every control cycle each drive is requested
to send motion and torque, and one drive in turn to send its health.
"""

import struct
import time
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from snakesim_can_backend.bus.bus import VirtualPeer, Wire, inject_into, receive_frames, wait
from snakesim_can_backend.bus.bus_errors import BUS_FAULTS
from snakesim_can_backend.protocol.definitions import CanFrame
from snakesim_drivers.emulation.emulated_body import FAULTS
from snakesim_drivers.kit.drive_states import DriveCommand, DriveStates
from snakesim_drivers.kit.drives import BusCommand, Drives
from snakesim_drivers.kit.findings import FaultFinding
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.wire.messages import JointMode

REQUEST_PERIOD_S = 0.1  # from one request to the next one to the same drive in bring-up
# After the last drive has responded: a second drive with its id may respond later.
DUPLICATE_WAIT_S = 0.06
MIN_UNKNOWN_NODE_FRAMES = 3  # a single frame of an unknown node may be left in a queue from before
HOST = -1  # the sender of a frame that only a host sends


@dataclass(frozen=True)
class CanDrivesContext:
    """What a driver type gets to operate the drives of one bus."""

    all_joints: Sequence[Joint]  # of the driver type, on all buses
    joints: Sequence[Joint]  # of this bus, from tail to head
    settings: Any  # the driver type's own `Settings`
    wire: Wire
    readings: DriveReadings
    emulator: VirtualPeer | None  # the drives, if they are emulated in this process
    emulated: bool  # True: no real motor moves
    response_timeout_s: float  # time that a reading waits for answers
    bring_up_timeout_s: float  # time that drives have to answer in bring-up
    cycle_ns: int  # from one setpoint to the next
    report_period_ns: int  # from one report of a drive's state to the next
    clock_ns: Callable[[], int]


class CanDrives(Drives):
    """All drives of a bus, from tail to head. In all methods `i` is the index of a drive on the bus.

    The abstract methods are what a driver type implements. They are called in the thread of the bus, in this order:

    * bring-up: `forget_identities`; `request_identity` until every drive `is_identified`; `validate_drive`; for each
      drive `send_command` with "idle", `clear_leftover_errors` and `write_settings`; then `request_motion` until motion
      and torque of every drive are known
    * a control cycle: `request_motion` to all, `request_health` to one; `send_setpoint` to the drives that follow, then
      `send_command` to those that change
    * the operator's reset of a fault: `clear_errors`, then `write_settings`
    * the end: `send_command` with "idle", then `restore_settings`

    `find_sender` and `handle_response` are called for frames that arrive, at any time.
    """

    missing_identity_text: str  # why a drive may not send its firmware version, for a message

    def __init__(self, context: CanDrivesContext) -> None:
        """Prepare to drive the joints on an open bus; nothing is sent before `bring_up`.

        Args:
            context: The open bus, its joints, the object that stores their readings, and the timeouts of the driver.
        """
        self._context = context
        self.emulated = context.emulated
        self._emulator = context.emulator
        # The bus and its drives.
        self.wire = context.wire
        self.node_ids = [joint.id for joint in context.joints]
        self._index_by_node_id = {node: i for i, node in enumerate(self.node_ids)}
        # Whether every drive was found and no other program uses the bus.
        self._is_brought_up = False
        # What drives report.
        self.readings = context.readings
        labels = [
            f"{joint.name} (node {joint.id} on {context.wire.channel})" for joint in context.joints
        ]
        self.states = DriveStates(labels, context.report_period_ns, context.clock_ns)
        self.firmware: list[tuple[int, ...]] = [()] * len(self.node_ids)  # (): not reported yet
        # Serial numbers that respond with the id of each joint. Two of them are two drives with one id.
        self._serials: list[list[str]] = [[] for _ in self.node_ids]
        self._last_health_request_index = 0  # index of the drive whose health was requested last
        # Other nodes on the bus.
        self._frame_count_by_unknown_node: Counter[int] = Counter()  # frames, by node
        self._has_seen_other_controller = False  # whether another program has commanded drives

    # --- the protocol of a driver type: frames that arrive ----------------------------------------------------

    @abstractmethod
    def find_sender(self, frame: CanFrame) -> int | None:
        """Return the id of the node that sent a frame.

        Returns:
            The node id; `HOST` if only a host sends such a frame; None if the frame is to be ignored.
        """

    @abstractmethod
    def handle_response(self, i: int, frame: CanFrame) -> None:
        """Store what a drive reports in `readings`, `states` and `firmware`.

        Raises:
            ValueError, LookupError, struct.error: The frame is malformed; the caller ignores it.
        """

    # --- the protocol of a driver type: bring-up, reset and end -----------------------------------------------

    @abstractmethod
    def request_identity(self, i: int) -> None:
        """Request firmware version and state, and whatever else `is_identified` needs."""

    def is_identified(self, i: int) -> bool:
        """Return whether a drive has sent everything that bring-up requests."""
        return bool(self.firmware[i])

    def forget_identities(self) -> None:
        """Forget what drives have reported, at the start of a bring-up."""
        self.firmware = [()] * len(self.node_ids)
        self._serials = [[] for _ in self.node_ids]

    @abstractmethod
    def validate_drive(self, i: int) -> str:
        """Check an identified drive, and store what later commands need of its configuration.

        Returns:
            The reason why the drive cannot be used, to be put after its name; an empty string if it can be used.
        """

    def find_start_up_problem(self, i: int) -> str:
        """Return why a drive cannot be used although its settings were written.

        Returns:
            The reason; an empty string if the drive can be used, or if that is not known yet.
        """
        del i
        return ""

    @abstractmethod
    def clear_leftover_errors(self, i: int) -> None:
        """Clear the errors that a driver that was killed leaves behind, and no others."""

    @abstractmethod
    def write_settings(self, i: int) -> None:
        """Write the settings that a drive loses when it restarts."""

    @abstractmethod
    def clear_errors(self, i: int) -> None:
        """Clear all errors of a drive, for the operator."""

    @abstractmethod
    def restore_settings(self, i: int) -> None:
        """Write back the settings that this driver has changed and the next one reads."""

    # --- the protocol of a driver type: a control cycle -------------------------------------------------------

    @abstractmethod
    def request_motion(self, i: int) -> bool:
        """Request motion and torque. Returns whether the bus accepted the request."""

    def is_awaiting_responses(self) -> bool:
        """Return whether a drive owes another response than motion and torque for which a reading should wait."""
        return False

    @abstractmethod
    def request_health(self, i: int) -> None:
        """Request supply, temperatures and errors."""

    @abstractmethod
    def send_setpoint(self, i: int, mode: JointMode, target: float, limit_nm: float) -> None:
        """Send a setpoint to a drive.

        Args:
            i: Index of the drive on its bus, from 0 at the tail.
            mode: Control mode of the setpoint.
            target: Target at the shaft in rad, rad/s or N·m, by the mode; 0 for a passive drive.
            limit_nm: Torque limit at the shaft.
        """

    @abstractmethod
    def send_command(self, i: int, command: DriveCommand) -> None:
        """Enable a drive ("follow"), switch it off ("idle"), or stop it by its own emergency stop ("stop")."""

    # --- `Drives`: bring-up, reset and end --------------------------------------------------------------------

    def bring_up(self) -> None:
        """Find and check every drive, write its settings, and wait for its first motion and torque.

        Every drive is off afterwards. Nothing but requests is sent before all drives are found and checked.

        Raises:
            BackendError: A drive is missing or unsuitable, or another program commands drives on this bus.
        """
        drives = range(len(self.node_ids))
        self.forget_identities()
        self._request_until_done(self.is_identified, self.request_identity)
        self._wait_for_duplicates()
        problems = [
            f"  {self.states.drives[i].label} {problem}"
            for i in drives
            for problem in self._find_identity_problems(i)
        ]
        if self._has_seen_other_controller:
            raise BackendError(
                "another program commands drives on this bus; end it first. Nothing was sent",
                code="bus/second-host",
            )
        if problems:
            raise BackendError(
                "the robot is not complete; nothing was enabled:",
                *problems,
                code="drive/not-complete",
            )
        self._is_brought_up = True
        for i in drives:
            self.send_command(i, "idle")
            self.clear_leftover_errors(i)
            self.write_settings(i)
        self._request_until_done(self._is_start_up_decided, self.request_motion)
        start_problems = {i: self.find_start_up_problem(i) for i in drives}
        problems = [
            f"  {self.states.drives[i].label} {problem}"
            for i, problem in start_problems.items()
            if problem
        ]
        if problems:
            raise BackendError(
                "the robot is not complete; nothing was enabled:",
                *problems,
                code="drive/not-complete",
            )
        silent_drives = [
            self.states.drives[i].label for i in drives if not self.readings.has_reported(i)
        ]
        if silent_drives:
            raise BackendError(
                f"{', '.join(silent_drives)}: no motion and torque; nothing was enabled",
                code="drive/silent",
            )
        for i in drives:
            self.request_health(i)
        self._receive()
        self._frame_count_by_unknown_node.clear()

    def record_serial(self, i: int, serial: str) -> None:
        """Store a serial number that a drive has sent: two serial numbers for one id are two drives with that id."""
        if serial not in self._serials[i]:
            self._serials[i].append(serial)
        self.readings.set_identity(i, serial=self._serials[i][0])

    def reset_faults(self, joints: frozenset[int]) -> None:
        """Clear errors of these drives, and write the settings that a restart may have lost."""
        self.states.reset_errors(joints)
        # A second drive that is still there answers again.
        self._serials = [serials[:1] for serials in self._serials]
        for i in sorted(joints):
            self.clear_errors(i)
            self.write_settings(i)

    def close(self) -> None:
        """Switch all drives off, as far as the bus still works, and close the bus."""
        if self._is_brought_up:
            for i in range(len(self.node_ids)):
                try:
                    self.send_command(i, "idle")
                    self.restore_settings(i)
                except BackendError:
                    continue
        try:
            self.wire.idle()
        finally:
            self.wire.close()

    # --- `Drives`: a control cycle ----------------------------------------------------------------------------

    def read(self) -> None:
        """Request motion and torque of all drives and the health of one, and wait for drives that responded lately."""
        self._receive()
        for i in range(len(self.node_ids)):
            if not self.request_motion(i):
                self.readings.skip_request(i)
        self._last_health_request_index = (self._last_health_request_index + 1) % len(self.node_ids)
        self.request_health(self._last_health_request_index)
        deadline_s = time.monotonic() + self._context.response_timeout_s
        while self.readings.is_awaiting_responses() or self.is_awaiting_responses():
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0 or not wait([self.wire], remaining_s):
                break
            self._receive()

    def send_setpoints(self, command: BusCommand) -> None:
        """Send setpoints to the enabled drives, then commands to drives that have to be switched on or off."""
        enabled_drives = command.enabled_drives
        if not command.may_enable:
            enabled_drives &= self.states.get_enabled_drives()
        for i in sorted(enabled_drives):
            self.send_setpoint(
                i, command.modes[i], float(command.targets[i]), float(command.limits_nm[i])
            )
        for i, drive_command in self.states.update_commands(
            enabled_drives, emergency=command.emergency
        ):
            self.send_command(i, drive_command)

    def poll(self) -> None:
        """Receive what has arrived; drives that are emulated here simulate up to the current time."""
        wait([self.wire], 0.0)
        self._receive()

    def inject(self, injection: FaultInjection, *, begins: bool) -> bool:
        """Start or end a fault of the bus or of a drive that is emulated here; return False for any other fault."""
        if inject_into([self.wire], injection, begins=begins):
            return True
        if self._emulator is None or injection.kind not in FAULTS:
            return False
        self._emulator.inject(injection, begins=begins)
        return True

    def list_findings(self) -> list[FaultFinding]:
        """Return what is wrong with the bus, with other nodes on it, and with its drives."""
        return [
            *self._find_bus_errors(),
            *self._find_unauthorized_nodes(),
            *self._find_duplicates(),
            *self.states.list_findings(),
        ]

    def handle_frame(self, frame: CanFrame) -> None:
        """Handle a received frame by its sender: store a drive's report, note another host or an unknown node."""
        sender = self.find_sender(frame)
        if sender is None:
            return
        i = self._index_by_node_id.get(sender)
        if i is not None:
            try:
                self.handle_response(i, frame)
            except (ValueError, LookupError, struct.error):
                return
        elif sender == HOST:
            self._has_seen_other_controller = True
        else:
            self._frame_count_by_unknown_node[sender] += 1

    # --- inside: findings -------------------------------------------------------------------------------------

    def _find_bus_errors(self) -> list[FaultFinding]:
        findings: list[FaultFinding] = []
        for error in self.wire.errors():
            if error.kind in BUS_FAULTS:
                cause = f"{error.channel}: {error.detail}; {BUS_FAULTS[error.kind]}"
                findings.append(FaultFinding(error.kind, cause))
        return findings

    def _find_unauthorized_nodes(self) -> list[FaultFinding]:
        """Return findings for another host and for unknown nodes."""
        findings: list[FaultFinding] = []
        if self._has_seen_other_controller:
            findings.append(
                FaultFinding(
                    "second_host", "another program commands drives on this bus; end one of the two"
                )
            )
            self._has_seen_other_controller = False
        for node, frame_count in self._frame_count_by_unknown_node.items():
            if frame_count >= MIN_UNKNOWN_NODE_FRAMES:
                findings.append(
                    FaultFinding(
                        "unknown_node",
                        f"node {node} is on the bus, but is not a joint of this robot",
                    )
                )
        return findings

    def _find_duplicates(self) -> list[FaultFinding]:
        """Return a finding for each id that two drives have. It affects all joints: their readings may be mixed up."""
        findings: list[FaultFinding] = []
        for i, serials in enumerate(self._serials):
            if len(serials) > 1:
                cause = (
                    f"{self.states.drives[i].label} is duplicated: serial numbers {' and '.join(serials)} answer; "
                    "give each drive its own id"
                )
                findings.append(FaultFinding("duplicate_node", cause, i))
        return findings

    def _find_identity_problems(self, i: int) -> list[str]:
        """Return what is wrong with the drive, or the drives, that responded in bring-up with the id of a joint."""
        problems: list[str] = []
        if not self.firmware[i]:
            problems.append(self.missing_identity_text)
        else:
            mismatch = self.validate_drive(i)
            if mismatch:
                problems.append(mismatch)
        serials = self._serials[i]
        if len(serials) > 1:
            problems.append(
                f"answers with {len(serials)} serial numbers, {' and '.join(serials)}: give each drive its own id"
            )
        return problems

    def _is_start_up_decided(self, i: int) -> bool:
        """Return whether waiting for a drive is over: it has sent motion and torque, or it cannot be used."""
        return self.readings.has_reported(i) or bool(self.find_start_up_problem(i))

    # --- inside: the bus --------------------------------------------------------------------------------------

    def _receive(self) -> None:
        for frame in self.wire.receive():
            self.handle_frame(frame)

    def _wait_for_duplicates(self) -> None:
        """Receive until a second drive with a known id would have responded.

        Emulated drives in this process end the wait earlier, when they have nothing more to send.
        """
        deadline_s = time.monotonic() + DUPLICATE_WAIT_S
        while True:
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0 or not wait([self.wire], remaining_s):
                break
            self._receive()
        self._receive()

    def _request_until_done(
        self, is_done: Callable[[int], bool], request: Callable[[int], object]
    ) -> None:
        """Repeat requests to all drives until all are done or the time for bring-up is over.

        Args:
            is_done: Function that returns whether a drive, by its index, needs no more requests.
            request: Function that sends the request to a drive, by its index.
        """
        drives = range(len(self.node_ids))
        deadline_s = time.monotonic() + self._context.bring_up_timeout_s
        next_request_s = 0.0
        while True:
            now_s = time.monotonic()
            if now_s >= deadline_s or all(is_done(i) for i in drives):
                return
            if now_s >= next_request_s:
                for i in drives:
                    request(i)
                next_request_s = now_s + REQUEST_PERIOD_S
            for _, frame in receive_frames([self.wire]):
                self.handle_frame(frame)
