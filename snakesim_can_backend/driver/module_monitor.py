"""Detects faults of joint modules and buses, and reports each with a cause that helps a person to locate it.

This module is pure: once in every control cycle it checks the `ModuleReports` and the bus errors. It reports each
finding once, until the robot's fault is reset; a finding that persists is then reported again.
"""

from collections.abc import Callable, Iterable, Sequence, Set

from snakesim_can_backend.bus.bus_errors import BUS_FAULTS, BusError
from snakesim_can_backend.driver.reports import ModuleReports, ModuleStatus
from snakesim_can_backend.protocol.definitions import ModuleState, Opcode
from snakesim_drivers.kit.findings import FaultFinding, ReportedFindings
from snakesim_hal.wire.messages import LifecycleState

MIN_UNANSWERED_SYNCS = 3  # Syncs without an answer
# Bad frames of one kind, or periods with a full bus, that make a fault instead of a glitch.
MIN_CONSECUTIVE_ERRORS = 3
CLEAR_GRACE_SYNCS = 5  # Syncs that a module may take to follow a Clear
ARM_GRACE_SYNCS = 5  # Syncs that a module may take to follow an Arm
MIN_UNKNOWN_NODE_FRAMES = 3  # of an unexpected node, in consecutive cycles
MAX_FRAMES_PER_CYCLE = 16  # of one module in a cycle; a healthy one sends 8 at most

NEVER_ARMED = "module_never_armed"
# Faults of one module that concern all others: two modules with one id, a full bus, water, the common supply, and an
# emergency. A robot that is not complete does not start, either.
ROBOT_FAULT_KINDS = {
    "duplicate_node",
    "module_babbling",
    "module_leak",
    "module_voltage",
    "module_emergency",
    NEVER_ARMED,
}

Report = Callable[[str, str], None]  # gets the kind of a finding and its cause


class ModuleMonitor:
    """Finds what is wrong with modules and buses, and remembers which findings it has reported."""

    def __init__(
        self, joint_names: Sequence[str], channel_by_joint: Sequence[str], period_s: float
    ) -> None:
        """Create the monitor of a robot's modules, before the first Sync.

        Args:
            joint_names: Names of all joints, from tail to head.
            channel_by_joint: Channel of every joint's module, from tail to head.
            period_s: Duration from one Sync to the next.
        """
        self._joint_names = joint_names
        self._channels = channel_by_joint
        self._period_s = period_s
        self._reported_findings = ReportedFindings()

        # By joint.
        self._restart_counts = [0] * len(joint_names)  # uptime decreases that were seen before
        # Consecutive Syncs in which a module did not follow the robot's arming.
        self._unarmed_sync_counts = [0] * len(joint_names)
        # Sync at which a module's uptime decreased.
        self._restart_sync_by_joint: dict[int, int] = {}
        self._restarted_joints: set[int] = set()  # modules that restarted since the last reset
        self._changed_joints: set[int] = set()  # modules whose parameters may have changed
        self._armed_joints: set[int] = set()  # modules that have been armed in this arm session

        # Of the robot.
        self._grace_end_sync = -1  # last Sync at which modules may not have followed a reset yet
        self._arm_session_start_sync: int | None = None  # first Sync of this arm session

        # By bus.
        # Consecutive cycles in which a bus rejected frames.
        self._rejecting_cycle_count_by_channel: dict[str, int] = {}
        # Newest Sync at which a bus rejected frames.
        self._last_rejected_sync_by_channel: dict[str, int] = {}
        self._down_channels: set[str] = set()  # buses whose interface is down
        # By node: frames in consecutive cycles, each with some.
        self._unknown_node_frames: dict[int, int] = {}
        self.minor_error_counts: dict[str, int] = {}  # bus errors that are not faults, by kind

    def reset(self, sync: int) -> None:
        """Report persistent findings again, because the robot's fault was reset at this Sync.

        The modules get CLEAR_GRACE_SYNCS Syncs to follow the clear.
        """
        self._reported_findings.reset()
        self._restarted_joints.clear()
        self._grace_end_sync = sync + CLEAR_GRACE_SYNCS

    def find_faults(
        self,
        module_reports: ModuleReports,
        lifecycle: LifecycleState,
        errors: Iterable[BusError] = (),
        rejecting_channels: Iterable[str] = (),
        unconfigured_joints: Iterable[int] = (),
        isolated_joints: Set[int] = frozenset(),
    ) -> list[FaultFinding]:
        """Check all modules and buses once in a control cycle, and return the findings that are new.

        The counts of consecutive errors are updated, so call it exactly once in each control cycle.

        Args:
            module_reports: Newest reports of the modules. Its counts of frames from other senders are reset.
            lifecycle: Lifecycle state of the robot.
            errors: Bus errors since the last call.
            rejecting_channels: Channels of the buses that rejected a frame in this cycle.
            unconfigured_joints: Joints that must not be armed, because their parameters may be wrong.
            isolated_joints: Isolated joints; findings that concern only an isolated joint are ignored.

        Returns:
            The findings that were not reported since the last reset.
        """
        unsent_channels = set(rejecting_channels)
        self._update_arm_session(lifecycle, module_reports.sync)
        for channel in unsent_channels:
            self._last_rejected_sync_by_channel[channel] = module_reports.sync

        findings = self._find_bus_faults(errors, unsent_channels)
        findings += self._find_unknown_nodes(module_reports)
        findings += self._find_other_host(module_reports)
        module_reports.reset_sender_counts()
        for joint, module in enumerate(module_reports.modules):
            findings += self._find_frame_faults(joint, module, module_reports)
            findings += self._find_state_faults(
                joint, module, module_reports, lifecycle, is_isolated=joint in isolated_joints
            )
        if lifecycle == "armed":
            findings += [
                self._make_unconfigured_finding(joint)
                for joint in unconfigured_joints
                if joint not in isolated_joints
            ]
        relevant = [
            finding
            for finding in findings
            if not (finding.affects_only_joint and finding.joint in isolated_joints)
        ]
        return self._reported_findings.filter_new(relevant)

    def pop_changed_joints(self) -> set[int]:
        """Return the joints whose parameters may have changed since the last call."""
        changed = self._changed_joints
        self._changed_joints = set()
        return changed

    def _update_arm_session(self, lifecycle: LifecycleState, sync: int) -> None:
        """Remember the first Sync of an arm session, and forget the session when it ends."""
        if lifecycle != "armed":
            self._arm_session_start_sync = None
            self._armed_joints.clear()
        elif self._arm_session_start_sync is None:
            self._arm_session_start_sync = sync

    # --- one module -------------------------------------------------------------------------------------------

    def _make_finding(
        self,
        joint_index: int,
        module: ModuleStatus,
        what: str,
        cause: str,
        also: Sequence[str] = (),
    ) -> FaultFinding:
        """Return a finding about a module; `also` names further kinds that apply."""
        subject = f"{self._joint_names[joint_index]} (node {module.node_id} on {self._channels[joint_index]})"
        concerns_only_this_joint = ROBOT_FAULT_KINDS.isdisjoint((what, *also))
        return FaultFinding(
            what, f"{subject} {cause}", joint_index, affects_only_joint=concerns_only_this_joint
        )

    def _find_frame_faults(
        self, joint_index: int, module: ModuleStatus, module_reports: ModuleReports
    ) -> list[FaultFinding]:
        """Return findings about the frames of a module, or about their absence."""
        findings: list[FaultFinding] = []

        def report(what: str, cause: str) -> None:
            findings.append(self._make_finding(joint_index, module, what, cause))

        self._report_restart(joint_index, module, module_reports, report)
        self._report_wrong_frames(module, module_reports, report)
        if not findings:
            self._report_silence(joint_index, module, module_reports, report)
        return findings

    def _report_restart(
        self, joint_index: int, module: ModuleStatus, module_reports: ModuleReports, report: Report
    ) -> None:
        if self._has_restarted(joint_index, module, module_reports):
            self._restarted_joints.add(joint_index)
            self._changed_joints.add(joint_index)
        if joint_index in self._restarted_joints:
            uptime_s = module.uptime_ms / 1000
            report(
                "module_restarted",
                f"has restarted, its uptime is {uptime_s:.2f} s: a reset writes its parameters again",
            )

    def _report_wrong_frames(
        self, module: ModuleStatus, module_reports: ModuleReports, report: Report
    ) -> None:
        """Report wrong counters and checksums, a second module with the same id, and too many frames."""
        if module.repeated_state_count >= MIN_CONSECUTIVE_ERRORS:
            report(
                "module_frozen",
                f"is frozen: it repeats its answer number {module.last_count} to every Sync",
            )
        elif module.wrong_counter_count >= MIN_CONSECUTIVE_ERRORS:
            report(
                "wrong_counter",
                f"answers Syncs that were not sent: {module.wrong_counter_count} wrong counters in a row",
            )
        if module.corrupt_state_count >= MIN_CONSECUTIVE_ERRORS:
            report(
                "bad_checksum",
                f"sends corrupt states: {module.corrupt_state_count} wrong checksums in a row",
            )
        if module.count_double_answers(module_reports.sync) >= MIN_CONSECUTIVE_ERRORS:
            report(
                "duplicate_node",
                "is duplicated: every Sync is answered twice; give each module its own node id",
            )
        if module.frame_count > MAX_FRAMES_PER_CYCLE:
            report(
                "module_babbling", f"floods the bus: {module.frame_count} frames within one period"
            )

    def _report_silence(
        self, joint_index: int, module: ModuleStatus, module_reports: ModuleReports, report: Report
    ) -> None:
        wrong_answers = module.corrupt_state_count + max(
            module.repeated_state_count, module.wrong_counter_count
        )
        without_answer = module_reports.sync - module.sync - wrong_answers
        # A Sync that the bus rejected did not reach the module.
        since_unsent = module_reports.sync - self._last_rejected_sync_by_channel.get(
            self._channels[joint_index], -1
        )
        unanswered = min(without_answer, since_unsent)
        if unanswered >= MIN_UNANSWERED_SYNCS:
            silence_ms = unanswered * self._period_s * 1000
            report(
                "module_silent",
                f"is silent: no state for {silence_ms:.0f} ms{_explain_silence(module, module_reports)}",
            )

    def _find_state_faults(
        self,
        joint_index: int,
        module: ModuleStatus,
        module_reports: ModuleReports,
        lifecycle: LifecycleState,
        *,
        is_isolated: bool,
    ) -> list[FaultFinding]:
        """Return a finding if the module reports a fault, or does not follow the robot's arming."""
        # An emergency stop is no reason to report a module that had no fault before it.
        stopped_on_command = (
            lifecycle == "estop" and module.state == ModuleState.EMERGENCY and not module.faults
        )
        may_report = module_reports.sync >= self._grace_end_sync
        if module.is_clear_required and not stopped_on_command and may_report:
            return [self._make_fault_finding(joint_index, module)]
        if is_isolated or not self._has_failed_to_arm(joint_index, module, module_reports):
            return []
        state = module.state.name.lower()
        if joint_index in self._armed_joints:
            return [
                self._make_finding(
                    joint_index, module, "module_not_armed", f"is not armed any more: it is {state}"
                )
            ]
        cause = f"does not arm: it is {state}"
        return [self._make_finding(joint_index, module, "module_not_armed", cause, [NEVER_ARMED])]

    def _make_fault_finding(self, joint_index: int, module: ModuleStatus) -> FaultFinding:
        """Return the finding about a module that is in a latched state."""
        state = module.state.name.lower()
        faults = module.list_fault_names()
        kinds = [f"module_{name}" for name in (*faults, state)]
        reported = ", ".join(faults) or state
        cause = f"reports {reported}; it stopped because of {module.last_stop.name.lower()}"
        return self._make_finding(joint_index, module, kinds[0], cause, kinds)

    def _has_restarted(
        self, joint_index: int, module: ModuleStatus, module_reports: ModuleReports
    ) -> bool:
        """Return whether a module has restarted, once for every restart.

        A second module with the same id also makes the uptime decrease, but then every Sync is answered twice. So the
        decision waits for MIN_CONSECUTIVE_ERRORS Syncs.
        """
        if module.restarts > self._restart_counts[joint_index]:
            self._restart_counts[joint_index] = module.restarts
            self._restart_sync_by_joint.setdefault(joint_index, module_reports.sync)
        restart_sync = self._restart_sync_by_joint.get(joint_index, module_reports.sync)
        if (
            module.count_double_answers(module_reports.sync)
            or module_reports.sync - restart_sync <= MIN_CONSECUTIVE_ERRORS
        ):
            return False
        del self._restart_sync_by_joint[joint_index]
        return True

    def _has_failed_to_arm(
        self, joint_index: int, module: ModuleStatus, module_reports: ModuleReports
    ) -> bool:
        """Return whether a module is not armed although the robot has been for long enough."""
        if self._arm_session_start_sync is None:
            return False
        if module.state == ModuleState.ARMED:
            self._armed_joints.add(joint_index)
        was_armed = joint_index in self._armed_joints
        had_time = module_reports.sync - self._arm_session_start_sync > ARM_GRACE_SYNCS or was_armed
        answered = module_reports.sync == module.sync and not module.count_double_answers(
            module_reports.sync
        )
        if had_time and answered and module.state != ModuleState.ARMED:
            self._unarmed_sync_counts[joint_index] += 1
        else:
            self._unarmed_sync_counts[joint_index] = 0
        # A module that was armed and is passive now has stopped: no further Sync is needed to be sure.
        fell_back = was_armed and module.state in (ModuleState.BOOT, ModuleState.DISARMED)
        needed_syncs = 1 if fell_back else MIN_CONSECUTIVE_ERRORS
        return self._unarmed_sync_counts[joint_index] >= needed_syncs

    def _make_unconfigured_finding(self, joint_index: int) -> FaultFinding:
        name = self._joint_names[joint_index]
        cause = (
            f"{name} has not accepted its parameters, and is not armed; reset, or power-cycle it"
        )
        return FaultFinding("module_not_configured", cause, joint_index)

    # --- the buses --------------------------------------------------------------------------------------------

    def _find_bus_faults(self, errors: Iterable[BusError], unsent: set[str]) -> list[FaultFinding]:
        """Return findings about bus errors, and about buses that have rejected frames for several cycles.

        Args:
            errors: Bus errors since the last call; errors that are not faults are only counted, in
                `minor_error_counts`.
            unsent: Channels of the buses that rejected a frame in this cycle.
        """
        findings: list[FaultFinding] = []
        for error in errors:
            if error.kind == "interface_down":
                self._down_channels.add(error.channel)
            elif error.kind == "interface_up":
                self._down_channels.discard(error.channel)
            suggestion = BUS_FAULTS.get(error.kind)
            if suggestion is None:
                self.minor_error_counts[error.kind] = self.minor_error_counts.get(error.kind, 0) + 1
            else:
                findings.append(
                    FaultFinding(error.kind, f"{error.channel}: {error.detail}; {suggestion}")
                )
        # Consecutive cycles are counted: a bus that sent everything in this cycle begins at 0 again. So does one whose
        # interface is down, which is a finding of its own.
        self._rejecting_cycle_count_by_channel = {
            channel: self._rejecting_cycle_count_by_channel.get(channel, 0) + 1
            for channel in unsent - self._down_channels
        }
        for channel, cycles in self._rejecting_cycle_count_by_channel.items():
            if cycles >= MIN_CONSECUTIVE_ERRORS:
                findings.append(self._make_stuck_bus_finding(channel))
        return findings

    def _make_stuck_bus_finding(self, channel: str) -> FaultFinding:
        duration_ms = 1000 * MIN_CONSECUTIVE_ERRORS * self._period_s
        cause = (
            f"{channel}: no frames sent for {duration_ms:.0f} ms, its transmit queue stays "
            f"full: no node acknowledges (power, cable, terminator, bit rate), or txqueuelen is below 64"
        )
        return FaultFinding("bus_stuck", cause)

    def _find_unknown_nodes(self, module_reports: ModuleReports) -> list[FaultFinding]:
        """Return a finding for each node on the bus that is no joint of this robot.

        One frame may be a transmission error, so a node is reported only after MIN_UNKNOWN_NODE_FRAMES frames. A
        cycle without any frame of a node sets the count of that node back to 0.

        Args:
            module_reports: Reports of the modules, with the frames of unknown nodes in this cycle.
        """
        frame_count_by_node: dict[int, int] = {}
        for node, new_frames in module_reports.unknown_node_frame_counts.items():
            frame_count_by_node[node] = self._unknown_node_frames.get(node, 0) + new_frames
        # Without the nodes that sent no frame in this cycle.
        self._unknown_node_frames = frame_count_by_node

        findings: list[FaultFinding] = []
        for node, frames in frame_count_by_node.items():
            if frames >= MIN_UNKNOWN_NODE_FRAMES:
                findings.append(
                    FaultFinding(
                        "unknown_node",
                        f"node {node} is on the bus, but is not a joint of this robot",
                    )
                )
        return findings

    def _find_other_host(self, module_reports: ModuleReports) -> list[FaultFinding]:
        """Return findings about frames that only a host sends and that this driver did not send.

        An Emergency may come from any node. Every other frame of a host shows that a second program commands the
        modules. It may have written their parameters, so all joints are marked as changed; see `pop_changed_joints`.

        Args:
            module_reports: Reports of the modules, with the frames of other hosts in this cycle, by opcode.
        """
        findings: list[FaultFinding] = []
        frame_count_by_opcode = module_reports.other_host_frame_counts
        if frame_count_by_opcode[Opcode.EMERGENCY]:
            findings.append(FaultFinding("emergency", "a node on the bus sent an Emergency"))
        if frame_count_by_opcode.keys() - {Opcode.EMERGENCY}:
            cause = "another program commands the modules on this bus; end one of the two"
            findings.append(FaultFinding("second_host", cause))
            self._changed_joints |= set(range(len(module_reports.modules)))
        return findings


def _explain_silence(module: ModuleStatus, module_reports: ModuleReports) -> str:
    """Return what a module's heartbeats show about the cause of its silence, as the end of a sentence."""
    if module.heartbeat_sync > module.sync:
        return "; it still sends heartbeats, so it receives no Sync or its main loop hangs"
    if module_reports.sync < 0 or module.uptime_ms < 0:
        return ""
    return "; no heartbeat either: power, cable or reset"
