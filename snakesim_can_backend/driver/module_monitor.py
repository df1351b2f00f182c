"""Detects module and bus faults, and reports each with a cause that helps a person to locate it.

Pure: checks a `Reading` and the bus errors once a tick. Each finding is reported once, until the robot's fault is
cleared; a persistent one is then reported again.
"""

from collections.abc import Iterable, Sequence, Set

from snakesim_can_backend.bus.bus_errors import BUS_FAULTS, BusError
from snakesim_can_backend.driver.reports import ModuleReports, ModuleStatus
from snakesim_can_backend.protocol.definitions import ModuleState, Opcode
from snakesim_drivers.kit.findings import Finding, Told
from snakesim_hal.wire.messages import LifecycleState

SILENT_AFTER = 3  # Syncs without an answer
IN_A_ROW = 3  # bad frames of one kind, or periods with a full bus, that make a fault instead of a glitch
CLEAR_GRACE = 5  # Syncs that a module may take to follow a clearing
ARM_GRACE = 5  # Syncs that a module may take to follow an arming
STRANGER_FRAMES = 3  # of an unexpected node, in consecutive ticks
MAX_FRAMES = 16  # of one module in a tick; a healthy one sends 8 at most

# Faults of one module that concern all others: two modules with one id, a full bus, water,
# the common supply, an emergency; and a robot that is not complete does not start.
NEVER_ARMED = "module_never_armed"
CONCERNS_ALL = {"duplicate_node", "module_babbling", "module_leak", "module_voltage", "module_emergency", NEVER_ARMED}


class ModuleMonitor:
    """Remembers which findings have been reported."""

    def __init__(self, joints: Sequence[str], channel_of: Sequence[str], period_s: float) -> None:
        """joints, channel_of: name and bus of every joint, tail to head."""
        self._names, self._channels = joints, channel_of
        self._period_s = period_s
        self._told = Told()
        self._restarts = [0] * len(joints)
        self._unarmed = [0] * len(joints)  # Syncs in a row in which a module was not armed although the robot was
        self._restart_at: dict[int, int] = {}  # joint -> Sync at which its uptime decreased
        self._quiet_until = -1  # last Sync at which modules may not have followed a clear yet
        self._armed_sync: int | None = None
        self._unsent: dict[str, int] = {}  # ticks in a row in which a bus rejected frames
        self._unasked: dict[str, int] = {}  # the newest Sync at which it did
        self._down: set[str] = set()  # buses whose interface is
        self._strangers: dict[int, int] = {}  # frames of unexpected nodes, in ticks in a row
        self._restarted: set[int] = set()  # joints, until a clear
        self._changed: set[int] = set()  # joints whose parameters may have changed
        self._was_armed: set[int] = set()  # joints, in this arming
        self.minor_error_counts: dict[str, int] = {}  # bus errors that are not faults, counted

    def reset(self, sync: int) -> None:
        """The fault was cleared: report persistent findings again once the modules have followed."""
        self._told.forget()
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
        """New findings.

        unsent: buses that rejected a frame of this tick; unconfigured: joints that must not be armed;
        isolated: isolated joints, whose findings are ignored if they concern no other joint.
        """
        if lifecycle != "armed":
            self._armed_sync = None
            self._was_armed.clear()
        elif self._armed_sync is None:
            self._armed_sync = reading.sync
        self._unasked |= dict.fromkeys(unsent := set(unsent), reading.sync)
        found = [*self._of_bus(errors, unsent), *self._of_strangers(reading)]
        for i, module in enumerate(reading.modules):
            found += self._of_answers(i, module, reading)
            found += self._of_state(i, module, reading, lifecycle, aside=i in isolated)
        if lifecycle == "armed":
            found += [self._bare(i) for i in unconfigured if i not in isolated]
        found = [finding for finding in found if not (finding.alone and finding.joint in isolated)]
        return self._told.fresh(found)

    def take_changed(self) -> set[int]:
        """Joints whose parameters may have changed since the last call."""
        changed, self._changed = self._changed, set()
        return changed

    # --- one module -------------------------------------------------------------------------------------------

    def _finding(self, i: int, module: ModuleStatus, what: str, cause: str, *also: str) -> Finding:
        """also: further kinds that apply."""
        who = f"{self._names[i]} (node {module.node} on {self._channels[i]})"
        return Finding(what, f"{who} {cause}", i, alone=CONCERNS_ALL.isdisjoint((what, *also)))

    def _of_answers(self, i: int, module: ModuleStatus, reading: ModuleReports) -> list[Finding]:
        """Findings about its frames, or that there are none."""
        found: list[Finding] = []

        def report(what: str, cause: str) -> None:
            found.append(self._finding(i, module, what, cause))

        if self._has_restarted(i, module, reading):
            self._restarted.add(i)
            self._changed.add(i)
        if i in self._restarted:
            up_s = module.uptime_ms / 1000
            report(
                "module_restarted",
                f"has restarted, its uptime is {up_s:.2f} s: a clear writes its parameters again",
            )
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
        unanswered = reading.sync - module.sync - module.corrupt - max(module.repeats, module.wrong_counts)
        unanswered = min(unanswered, reading.sync - self._unasked.get(self._channels[i], -1))
        if unanswered >= SILENT_AFTER and not found:
            report(
                "module_silent",
                f"is silent: no state for {unanswered * self._period_s * 1000:.0f} ms{_alive(module, reading)}",
            )
        return found

    def _of_state(
        self, i: int, module: ModuleStatus, reading: ModuleReports, lifecycle: LifecycleState, *, aside: bool
    ) -> list[Finding]:
        """Findings about faults that it reports, or that it does not follow."""
        state = module.state.name.lower()
        # An emergency stop says nothing of a fault that had stopped the module before it.
        as_told = lifecycle == "estop" and module.state == ModuleState.EMERGENCY and not module.faults
        if module.needs_clearing and not as_told and reading.sync >= self._quiet_until:
            faults = module.fault_names()
            kinds = [f"module_{word}" for word in (*faults, state)]
            why = f"it stopped because of {module.last_stop.name.lower()}"
            return [self._finding(i, module, kinds[0], f"reports {', '.join(faults) or state}; {why}", *kinds)]
        if aside or not self._refuses_to_arm(i, module, reading):
            return []
        if i in self._was_armed:
            return [self._finding(i, module, "module_not_armed", f"is not armed any more: it is {state}")]
        return [self._finding(i, module, "module_not_armed", f"does not arm: it is {state}", NEVER_ARMED)]

    def _has_restarted(self, i: int, module: ModuleStatus, reading: ModuleReports) -> bool:
        """A second module with the same id also makes the uptime decrease, but then every Sync is answered twice."""
        if module.restarts > self._restarts[i]:
            self._restarts[i] = module.restarts
            self._restart_at.setdefault(i, reading.sync)
        if module.answered_twice(reading.sync) or reading.sync - self._restart_at.get(i, reading.sync) <= IN_A_ROW:
            return False
        del self._restart_at[i]
        return True

    def _refuses_to_arm(self, i: int, module: ModuleStatus, reading: ModuleReports) -> bool:
        if self._armed_sync is None:
            return False
        if module.state == ModuleState.ARMED:
            self._was_armed.add(i)
        late = reading.sync - self._armed_sync > ARM_GRACE or i in self._was_armed
        apart = (
            late
            and reading.sync == module.sync
            and module.state != ModuleState.ARMED
            and not module.answered_twice(reading.sync)
        )
        self._unarmed[i] = self._unarmed[i] + 1 if apart else 0
        fell_back = i in self._was_armed and module.state in (ModuleState.BOOT, ModuleState.DISARMED)
        return self._unarmed[i] >= (1 if fell_back else IN_A_ROW)

    def _bare(self, i: int) -> Finding:
        cause = f"{self._names[i]} has not accepted its parameters, and is not armed; clear, or power-cycle it"
        return Finding("module_not_configured", cause, i)

    # --- the bus ----------------------------------------------------------------------------------------------

    def _of_bus(self, errors: Iterable[BusError], unsent: set[str]) -> list[Finding]:
        found: list[Finding] = []
        for error in errors:
            if error.kind == "interface_down":
                self._down.add(error.channel)
            elif error.kind == "interface_up":
                self._down.discard(error.channel)
            advice = BUS_FAULTS.get(error.kind)
            if advice is not None:
                found.append(Finding(error.kind, f"{error.channel}: {error.detail}; {advice}"))
            else:
                self.minor_error_counts[error.kind] = self.minor_error_counts.get(error.kind, 0) + 1
        self._unsent = {channel: self._unsent.get(channel, 0) + 1 for channel in unsent - self._down}
        for channel, ticks in self._unsent.items():
            if ticks >= IN_A_ROW:
                took_ms = 1000 * IN_A_ROW * self._period_s
                cause = (
                    f"{channel}: no frames sent for {took_ms:.0f} ms, its transmit queue stays "
                    f"full: no node acknowledges (power, cable, terminator, bit rate), or txqueuelen is below 64"
                )
                found.append(Finding("bus_stuck", cause))
        return found

    def _of_strangers(self, reading: ModuleReports) -> list[Finding]:
        found: list[Finding] = []
        self._strangers = {node: self._strangers.get(node, 0) + n for node, n in reading.unknown_nodes.items()}
        for node, frames in self._strangers.items():
            if frames >= STRANGER_FRAMES:
                found.append(Finding("unknown_node", f"node {node} is on the bus, but is not a joint of this robot"))
        reading.unknown_nodes.clear()
        others = reading.from_other_host
        if others[Opcode.EMERGENCY]:
            found.append(Finding("emergency", "a node on the bus sent an Emergency"))
        if others.keys() - {Opcode.EMERGENCY}:
            found.append(Finding("second_host", "another program commands the modules on this bus; end one of the two"))
            self._changed |= set(range(len(reading.modules)))
        others.clear()
        return found


def _alive(module: ModuleStatus, reading: ModuleReports) -> str:
    if module.heartbeat_sync > module.sync:
        return "; it still sends heartbeats, so it receives no Sync or its main loop hangs"
    if reading.sync < 0 or module.uptime_ms < 0:
        return ""
    return "; no heartbeat either: power, cable or reset"
