"""Detects faults of joint modules and buses, and reports each with a cause that helps a person to locate it.

This module is pure: once in every control cycle it checks the `ModuleReports` and the bus errors. It reports each
finding once, until the robot's fault is reset; a finding that persists is then reported again.
"""

from collections.abc import Callable, Iterable, Sequence, Set

from snakesim_can_backend.bus.bus_errors import BUS_FAULTS, BusError
from snakesim_can_backend.driver.reports import ModuleReports, ModuleStatus
from snakesim_can_backend.protocol.definitions import ModuleState, Opcode
from snakesim_drivers.kit.findings import Finding, ReportedFindings
from snakesim_hal.wire.messages import LifecycleState

SILENT_AFTER = 3  # Syncs without an answer
IN_A_ROW = 3  # bad frames of one kind, or periods with a full bus, that make a fault instead of a glitch
CLEAR_GRACE = 5  # Syncs that a module may take to follow a Clear
ARM_GRACE = 5  # Syncs that a module may take to follow an Arm
UNKNOWN_NODE_FRAMES = 3  # of an unexpected node, in consecutive cycles
MAX_FRAMES = 16  # of one module in a cycle; a healthy one sends 8 at most

NEVER_ARMED = "module_never_armed"
# Faults of one module that concern all others: two modules with one id, a full bus, water, the common supply, and an
# emergency. A robot that is not complete does not start, either.
CONCERNS_ALL = {"duplicate_node", "module_babbling", "module_leak", "module_voltage", "module_emergency", NEVER_ARMED}

Report = Callable[[str, str], None]  # gets the kind of a finding and its cause


class ModuleMonitor:
    """Finds what is wrong with modules and buses, and remembers which findings it has reported."""

    def __init__(self, joints: Sequence[str], channel_of: Sequence[str], period_s: float) -> None:
        """Create the monitor of a robot's modules, which remembers what it has seen from Sync to Sync.

        Args:
            joints: name of every joint, tail to head.
            channel_of: channel of every joint's module, tail to head.
            period_s: time between two Syncs.
        """
        self._names = joints
        self._channels = channel_of
        self._period_s = period_s
        self._reported = ReportedFindings()

        # By joint.
        self._restarts = [0] * len(joints)  # uptime decreases that were seen before
        self._unarmed = [0] * len(joints)  # consecutive Syncs in which a module did not follow the robot's arming
        self._restart_sync: dict[int, int] = {}  # Sync at which a module's uptime decreased
        self._restarted: set[int] = set()  # modules that restarted since the last reset
        self._changed: set[int] = set()  # modules whose parameters may have changed
        self._was_armed: set[int] = set()  # modules that have been armed in this arm session

        # Of the robot.
        self._quiet_until = -1  # last Sync at which modules may not have followed a reset yet
        self._armed_sync: int | None = None  # first Sync of this arm session

        # By bus.
        self._unsent: dict[str, int] = {}  # consecutive cycles in which a bus rejected frames
        self._unsent_sync: dict[str, int] = {}  # newest Sync at which a bus rejected frames
        self._down: set[str] = set()  # buses whose interface is down
        self._unknown_node_frames: dict[int, int] = {}  # by node: frames in consecutive cycles, each with some
        self.minor_error_counts: dict[str, int] = {}  # bus errors that are not faults, by kind

    def reset(self, sync: int) -> None:
        """Report persistent findings again, because the robot's fault was reset at this Sync.

        The modules get CLEAR_GRACE Syncs to follow the clear.
        """
        self._reported.reset()
        self._restarted.clear()
        self._quiet_until = sync + CLEAR_GRACE

    def find_faults(
        self,
        reading: ModuleReports,
        lifecycle: LifecycleState,
        errors: Iterable[BusError] = (),
        unsent: Iterable[str] = (),
        unconfigured: Iterable[int] = (),
        isolated: Set[int] = frozenset(),
    ) -> list[Finding]:
        """Return the findings of this cycle that were not reported before.

        Args:
            reading: reports of the modules.
            lifecycle: state of the robot.
            errors: bus errors since the last call.
            unsent: channels of the buses that rejected a frame in this cycle.
            unconfigured: joints that must not be armed, because their parameters may be wrong.
            isolated: isolated joints; findings that concern only an isolated joint are ignored.
        """
        unsent_channels = set(unsent)
        self._follow_lifecycle(lifecycle, reading.sync)
        for channel in unsent_channels:
            self._unsent_sync[channel] = reading.sync

        findings = self._check_buses(errors, unsent_channels)
        findings += self._find_unknown_nodes(reading)
        findings += self._find_other_host(reading)
        reading.reset_sender_counts()
        for joint, module in enumerate(reading.modules):
            findings += self._check_answers(joint, module, reading)
            findings += self._check_state(joint, module, reading, lifecycle, isolated=joint in isolated)
        if lifecycle == "armed":
            findings += [self._unconfigured_finding(joint) for joint in unconfigured if joint not in isolated]
        relevant = [finding for finding in findings if not (finding.alone and finding.joint in isolated)]
        return self._reported.filter_new(relevant)

    def take_changed(self) -> set[int]:
        """Return the joints whose parameters may have changed since the last call."""
        changed = self._changed
        self._changed = set()
        return changed

    def _follow_lifecycle(self, lifecycle: LifecycleState, sync: int) -> None:
        """Remember the first Sync of an arm session, and forget the session when it ends."""
        if lifecycle != "armed":
            self._armed_sync = None
            self._was_armed.clear()
        elif self._armed_sync is None:
            self._armed_sync = sync

    # --- one module -------------------------------------------------------------------------------------------

    def _make_finding(
        self, joint: int, module: ModuleStatus, what: str, cause: str, also: Sequence[str] = ()
    ) -> Finding:
        """Return a finding about a module; `also` names further kinds that apply."""
        subject = f"{self._names[joint]} (node {module.node} on {self._channels[joint]})"
        concerns_only_this_joint = CONCERNS_ALL.isdisjoint((what, *also))
        return Finding(what, f"{subject} {cause}", joint, alone=concerns_only_this_joint)

    def _check_answers(self, joint: int, module: ModuleStatus, reading: ModuleReports) -> list[Finding]:
        """Return findings about the frames of a module, or about their absence."""
        findings: list[Finding] = []

        def report(what: str, cause: str) -> None:
            findings.append(self._make_finding(joint, module, what, cause))

        self._check_restart(joint, module, reading, report)
        self._check_frames(module, reading, report)
        if not findings:
            self._check_silence(joint, module, reading, report)
        return findings

    def _check_restart(self, joint: int, module: ModuleStatus, reading: ModuleReports, report: Report) -> None:
        if self._has_restarted(joint, module, reading):
            self._restarted.add(joint)
            self._changed.add(joint)
        if joint in self._restarted:
            uptime_s = module.uptime_ms / 1000
            report(
                "module_restarted",
                f"has restarted, its uptime is {uptime_s:.2f} s: a reset writes its parameters again",
            )

    def _check_frames(self, module: ModuleStatus, reading: ModuleReports, report: Report) -> None:
        """Report wrong counters and checksums, a second module with the same id, and too many frames."""
        if module.repeats >= IN_A_ROW:
            report("module_frozen", f"is frozen: it repeats its answer number {module.last_count} to every Sync")
        elif module.wrong_counts >= IN_A_ROW:
            report("wrong_counter", f"answers Syncs that were not sent: {module.wrong_counts} wrong counters in a row")
        if module.corrupt >= IN_A_ROW:
            report("bad_checksum", f"sends corrupt states: {module.corrupt} wrong checksums in a row")
        if module.answered_twice(reading.sync) >= IN_A_ROW:
            report("duplicate_node", "is duplicated: every Sync is answered twice; give each module its own node id")
        if module.frames > MAX_FRAMES:
            report("module_babbling", f"floods the bus: {module.frames} frames within one period")

    def _check_silence(self, joint: int, module: ModuleStatus, reading: ModuleReports, report: Report) -> None:
        wrong_answers = module.corrupt + max(module.repeats, module.wrong_counts)
        without_answer = reading.sync - module.sync - wrong_answers
        # A Sync that the bus rejected did not reach the module.
        since_unsent = reading.sync - self._unsent_sync.get(self._channels[joint], -1)
        unanswered = min(without_answer, since_unsent)
        if unanswered >= SILENT_AFTER:
            silence_ms = unanswered * self._period_s * 1000
            report("module_silent", f"is silent: no state for {silence_ms:.0f} ms{_explain_silence(module, reading)}")

    def _check_state(
        self, joint: int, module: ModuleStatus, reading: ModuleReports, lifecycle: LifecycleState, *, isolated: bool
    ) -> list[Finding]:
        """Return a finding if the module reports a fault, or does not follow the robot's arming."""
        # An emergency stop is no reason to report a module that had no fault before it.
        stopped_on_command = lifecycle == "estop" and module.state == ModuleState.EMERGENCY and not module.faults
        may_report = reading.sync >= self._quiet_until
        if module.needs_clearing and not stopped_on_command and may_report:
            return [self._fault_finding(joint, module)]
        if isolated or not self._refuses_to_arm(joint, module, reading):
            return []
        state = module.state.name.lower()
        if joint in self._was_armed:
            return [self._make_finding(joint, module, "module_not_armed", f"is not armed any more: it is {state}")]
        cause = f"does not arm: it is {state}"
        return [self._make_finding(joint, module, "module_not_armed", cause, [NEVER_ARMED])]

    def _fault_finding(self, joint: int, module: ModuleStatus) -> Finding:
        """Return the finding about a module that is in a latched state."""
        state = module.state.name.lower()
        faults = module.fault_names()
        kinds = [f"module_{name}" for name in (*faults, state)]
        reported = ", ".join(faults) or state
        cause = f"reports {reported}; it stopped because of {module.last_stop.name.lower()}"
        return self._make_finding(joint, module, kinds[0], cause, kinds)

    def _has_restarted(self, joint: int, module: ModuleStatus, reading: ModuleReports) -> bool:
        """Return whether a module has restarted, once for every restart.

        A second module with the same id also makes the uptime decrease, but then every Sync is answered twice. So the
        decision waits for IN_A_ROW Syncs.
        """
        if module.restarts > self._restarts[joint]:
            self._restarts[joint] = module.restarts
            self._restart_sync.setdefault(joint, reading.sync)
        restart_sync = self._restart_sync.get(joint, reading.sync)
        if module.answered_twice(reading.sync) or reading.sync - restart_sync <= IN_A_ROW:
            return False
        del self._restart_sync[joint]
        return True

    def _refuses_to_arm(self, joint: int, module: ModuleStatus, reading: ModuleReports) -> bool:
        """Return whether a module is not armed although the robot has been for long enough."""
        if self._armed_sync is None:
            return False
        if module.state == ModuleState.ARMED:
            self._was_armed.add(joint)
        was_armed = joint in self._was_armed
        had_time = reading.sync - self._armed_sync > ARM_GRACE or was_armed
        answered = reading.sync == module.sync and not module.answered_twice(reading.sync)
        if had_time and answered and module.state != ModuleState.ARMED:
            self._unarmed[joint] += 1
        else:
            self._unarmed[joint] = 0
        # A module that was armed and is passive now has stopped: no further Sync is needed to be sure.
        fell_back = was_armed and module.state in (ModuleState.BOOT, ModuleState.DISARMED)
        needed_syncs = 1 if fell_back else IN_A_ROW
        return self._unarmed[joint] >= needed_syncs

    def _unconfigured_finding(self, joint: int) -> Finding:
        cause = f"{self._names[joint]} has not accepted its parameters, and is not armed; reset, or power-cycle it"
        return Finding("module_not_configured", cause, joint)

    # --- the buses --------------------------------------------------------------------------------------------

    def _check_buses(self, errors: Iterable[BusError], unsent: set[str]) -> list[Finding]:
        """Return findings about bus errors, and about buses that have rejected frames for several cycles.

        Args:
            errors: bus errors since the last call; those that are not faults are only counted, in
                `minor_error_counts`.
            unsent: channels of the buses that rejected a frame in this cycle.
        """
        findings: list[Finding] = []
        for error in errors:
            if error.kind == "interface_down":
                self._down.add(error.channel)
            elif error.kind == "interface_up":
                self._down.discard(error.channel)
            advice = BUS_FAULTS.get(error.kind)
            if advice is None:
                self.minor_error_counts[error.kind] = self.minor_error_counts.get(error.kind, 0) + 1
            else:
                findings.append(Finding(error.kind, f"{error.channel}: {error.detail}; {advice}"))
        # Consecutive cycles are counted: a bus that sent everything in this cycle begins at 0 again. So does one whose
        # interface is down, which is a finding of its own.
        self._unsent = {channel: self._unsent.get(channel, 0) + 1 for channel in unsent - self._down}
        for channel, cycles in self._unsent.items():
            if cycles >= IN_A_ROW:
                findings.append(self._stuck_finding(channel))
        return findings

    def _stuck_finding(self, channel: str) -> Finding:
        duration_ms = 1000 * IN_A_ROW * self._period_s
        cause = (
            f"{channel}: no frames sent for {duration_ms:.0f} ms, its transmit queue stays "
            f"full: no node acknowledges (power, cable, terminator, bit rate), or txqueuelen is below 64"
        )
        return Finding("bus_stuck", cause)

    def _find_unknown_nodes(self, reading: ModuleReports) -> list[Finding]:
        """Return a finding for each node on the bus that is no joint of this robot.

        One frame may be a transmission error, so a node is reported only after UNKNOWN_NODE_FRAMES frames. A cycle
        without any frame of a node ends the count of that node.

        Args:
            reading: reports of the modules, with the frames of unknown nodes in this cycle.
        """
        frame_counts: dict[int, int] = {}
        for node, new_frames in reading.unknown_nodes.items():
            frame_counts[node] = self._unknown_node_frames.get(node, 0) + new_frames
        self._unknown_node_frames = frame_counts  # without the nodes that sent no frame in this cycle

        findings: list[Finding] = []
        for node, frames in frame_counts.items():
            if frames >= UNKNOWN_NODE_FRAMES:
                findings.append(Finding("unknown_node", f"node {node} is on the bus, but is not a joint of this robot"))
        return findings

    def _find_other_host(self, reading: ModuleReports) -> list[Finding]:
        """Return findings about frames that only a host sends and that this driver did not send.

        An Emergency may come from any node. Every other frame of a host shows that a second program commands the
        modules. It may have written their parameters, so all joints are marked as changed; see `take_changed`.

        Args:
            reading: reports of the modules, with the frames of other hosts in this cycle, by opcode.
        """
        findings: list[Finding] = []
        other_host = reading.from_other_host
        if other_host[Opcode.EMERGENCY]:
            findings.append(Finding("emergency", "a node on the bus sent an Emergency"))
        if other_host.keys() - {Opcode.EMERGENCY}:
            cause = "another program commands the modules on this bus; end one of the two"
            findings.append(Finding("second_host", cause))
            self._changed |= set(range(len(reading.modules)))
        return findings


def _explain_silence(module: ModuleStatus, reading: ModuleReports) -> str:
    """Return what a module's heartbeats show about the cause of its silence, as the end of a sentence."""
    if module.heartbeat_sync > module.sync:
        return "; it still sends heartbeats, so it receives no Sync or its main loop hangs"
    if reading.sync < 0 or module.uptime_ms < 0:
        return ""
    return "; no heartbeat either: power, cable or reset"
