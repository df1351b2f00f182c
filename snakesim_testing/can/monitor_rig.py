"""Runs the fault monitor of the driver on three modules, the second of which can fail in a chosen way."""

from collections.abc import Callable

from snakesim_can_backend.bus.bus_errors import BusError
from snakesim_can_backend.driver.module_monitor import FaultFinding, ModuleMonitor
from snakesim_can_backend.driver.reports import ModuleReports
from snakesim_can_backend.protocol.definitions import CanFrame, LastStop, ModuleState
from snakesim_hal.wire.messages import LifecycleState
from snakesim_testing.can.frames import answer_sync, make_heartbeat_frame, start_sync

JOINT_COUNT = 3
ALL_NODES = (1, 2, 3)
PERIOD_S = 0.01
JOINT_2_LABEL = "joint_2 (node 2 on can0) "
Reply = Callable[[ModuleReports], None]


def send_nothing(_reports: ModuleReports) -> None:
    """Let node 2 be silent."""


class MonitorRig:
    """A robot whose joint_2 replies as a test wants, while the other joints answer every Sync."""

    def __init__(self) -> None:
        self.reports = ModuleReports(JOINT_COUNT)
        self.monitor = ModuleMonitor(
            ["joint_1", "joint_2", "joint_3"], ["can0", "can0", "can1"], PERIOD_S
        )
        self.lifecycle: LifecycleState = "disarmed"
        self.state = ModuleState.DISARMED
        self.isolated: set[int] = set()
        self.run_ticks(3)

    def run_tick(
        self, reply: Reply | None = None, errors: list[BusError] | None = None, unsent: str = ""
    ) -> list[FaultFinding]:
        """Start a Sync, let the modules answer it, and return what the monitor finds.

        Args:
            reply: Sends what node 2 sends instead of its answer. None: node 2 answers as the others.
            errors: Errors that the buses report.
            unsent: The bus that did not accept a frame. Empty for no bus.
        """
        start_sync(self.reports)
        if reply is None:
            answer_sync(self.reports, ALL_NODES, state=self.state)
        else:
            answer_sync(self.reports, (1, 3), state=self.state)
            reply(self.reports)
        unsent_on = [unsent] if unsent else []
        return self.monitor.find_faults(
            self.reports, self.lifecycle, errors or (), unsent_on, isolated_joints=self.isolated
        )

    def run_ticks(self, count: int, reply: Reply | None = None) -> list[FaultFinding]:
        """Run several ticks with the same reply of node 2, and return all findings."""
        return [finding for _ in range(count) for finding in self.run_tick(reply)]

    def reset(self) -> None:
        """Reset the faults that the monitor has reported."""
        self.monitor.reset(self.reports.sync)


def make_reply(state: ModuleState = ModuleState.DISARMED, *frames: CanFrame) -> Reply:
    """Return a reply in which node 2 answers in this state, and further frames arrive."""

    def reply(reports: ModuleReports) -> None:
        answer_sync(reports, [2], state=state)
        for frame in frames:
            reports.process_frame(frame)

    return reply


def make_heartbeat_reply(state: ModuleState = ModuleState.DISARMED, **signals: float) -> Reply:
    """Return a reply in which node 2 answers in this state, and sends a heartbeat with these signals."""
    return make_reply(state, make_heartbeat_frame(2, 1.0, state, **signals))


OVERHEATED = make_heartbeat_reply(ModuleState.FAULT, last_stop=LastStop.OVERHEAT, fault_overheat=1)
OVERHEATED_WITH_LEAK = make_heartbeat_reply(
    ModuleState.FAULT, last_stop=LastStop.OVERHEAT, fault_overheat=1, fault_leak=1
)


def list_findings(findings: list[FaultFinding]) -> list[tuple[str, int | None]]:
    """Return the kind and the joint of each finding."""
    return [(finding.what, finding.joint) for finding in findings]
