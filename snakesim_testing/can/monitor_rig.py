"""A watch over three modules, and what one of them can do wrong."""

from collections.abc import Callable

from snakesim_can_backend.bus.bus_errors import BusError
from snakesim_can_backend.driver.module_monitor import FaultFinding, ModuleMonitor
from snakesim_can_backend.driver.reports import ModuleReports
from snakesim_can_backend.protocol.definitions import CanFrame, LastStop, ModuleState
from snakesim_hal.wire.messages import LifecycleState
from snakesim_testing.can.frames import answer, begin, heartbeat

JOINTS = 3
EVERYBODY = (1, 2, 3)
PERIOD_S = 0.01
WHO = "joint_2 (node 2 on can0) "
Speak = Callable[[ModuleReports], None]


def quiet(_reading: ModuleReports) -> None:
    """Nothing comes of node 2."""


class MonitorRig:
    """Ticks of a robot whose joint_2 does what a test wants; the others are well."""

    def __init__(self) -> None:
        self.reading = ModuleReports(JOINTS)
        self.watch = ModuleMonitor(
            ["joint_1", "joint_2", "joint_3"], ["can0", "can0", "can1"], PERIOD_S
        )
        self.lifecycle: LifecycleState = "disarmed"
        self.state = ModuleState.DISARMED
        self.isolated: set[int] = set()
        self.ticks(3)

    def tick(
        self, speak: Speak | None = None, errors: list[BusError] | None = None, unsent: str = ""
    ) -> list[FaultFinding]:
        """One Sync and its look. speak: what comes of node 2, instead of an answer."""
        begin(self.reading)
        answer(self.reading, EVERYBODY if speak is None else (1, 3), state=self.state)
        if speak is not None:
            speak(self.reading)
        unsent_on = [unsent] if unsent else []
        return self.watch.find_faults(
            self.reading, self.lifecycle, errors or (), unsent_on, isolated_joints=self.isolated
        )

    def ticks(self, count: int, speak: Speak | None = None) -> list[FaultFinding]:
        return [found for _ in range(count) for found in self.tick(speak)]

    def reset(self) -> None:
        self.watch.reset(self.reading.sync)


def answering(state: ModuleState = ModuleState.DISARMED, *frames: CanFrame) -> Speak:
    """Node 2 answers in this state, and these frames come, too."""

    def speak(reading: ModuleReports) -> None:
        answer(reading, [2], state=state)
        for frame in frames:
            reading.process_frame(frame)

    return speak


def reporting(state: ModuleState = ModuleState.DISARMED, **values: float) -> Speak:
    """Node 2 answers in this state, and sends a heartbeat with more values."""
    return answering(state, heartbeat(2, 1.0, state, **values))


HOT = reporting(ModuleState.FAULT, last_stop=LastStop.OVERHEAT, fault_overheat=1)
HOT_AND_WET = reporting(
    ModuleState.FAULT, last_stop=LastStop.OVERHEAT, fault_overheat=1, fault_leak=1
)


def list_findings(findings: list[FaultFinding]) -> list[tuple[str, int | None]]:
    return [(finding.what, finding.joint) for finding in findings]
