"""Runs a driver and emulated drives tick by tick in lockstep, and controls the lifecycle as the HAL host does."""

from typing import Any

from snakesim_drivers.kit.drive_backend import DriveBackend
from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.model.fault_kinds import parse_injection
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import Fault, JointMode, JointState, LifecycleState


def bus_of(backend: Any, bus_index: int = 0) -> Any:
    """Return one bus of a backend."""
    return backend._drives.buses[bus_index]


def drives_of(backend: Any, bus_index: int = 0) -> Any:
    """Return the drives on one bus of a backend."""
    return bus_of(backend, bus_index).drives


class DriveRig:
    """A driver whose joints all get the same setpoint while armed. Otherwise they are passive, or damp in a fault."""

    def __init__(self, config: RunConfig, backend: DriveBackend) -> None:
        """Start at tick 0, with a position setpoint of 0.1 rad for every joint.

        Args:
            config: Configuration of the run.
            backend: The driver, which is open.
        """
        self.config = config
        self.backend = backend
        self.tick = 0
        self.isolated = frozenset[int]()  # indices of joints

        # Setpoint of every joint.
        self.mode = JointMode.POSITION
        self.target = 0.1
        self.limit_nm = 1.0
        self.damps = False  # whether the joints damp in a fault

        self.joints: JointState | None = None  # newest joint state

    def run(self, ticks: int, lifecycle: LifecycleState) -> list[Fault]:
        """Sample, command and advance for some control periods.

        Args:
            ticks: Number of control periods.
            lifecycle: Lifecycle state of the robot. From the first fault on it is "fault" instead, as in the host.

        Returns:
            The faults that the driver reported.
        """
        found: list[Fault] = []
        for _ in range(ticks):
            self.joints = self.backend.sample(self.tick, self.tick * self.config.period_ns).joints
            count = len(self.joints.angle_rad)
            mode, target = self._setpoint(lifecycle)
            self.backend.enact(
                SafeSetpoints(
                    [mode] * count, [target] * count, [self.limit_nm] * count, self.isolated
                ),
                lifecycle,
            )
            self.backend.advance()
            found += self.backend.faults()
            if found and lifecycle in ("armed", "disarmed"):
                lifecycle = "fault"
            self.tick += 1
        return found

    def _setpoint(self, lifecycle: LifecycleState) -> tuple[JointMode, float]:
        match lifecycle:
            case "armed":
                return self.mode, self.target
            case "fault" if self.damps:
                return JointMode.VELOCITY, 0.0
            case _:
                return JointMode.PASSIVE, self.target

    def go_wrong(self, text: str, *, begins: bool = True) -> None:
        """Begin or end a fault, such as `mute:joint_2@0-9`."""
        assert self.backend.inject(parse_injection(text), begins=begins)
