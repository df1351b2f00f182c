"""Loads the backend of docs/hardware/write-a-backend.md, and extends it by drives and by a simulated bus."""

import dataclasses
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import numpy as np

from snakesim_drivers.kit.braking import AT_REST_SPEED_RAD_S
from snakesim_drivers.kit.drive_backend import LATCHED_STATES
from snakesim_hal.backend import SafeSetpoints, Samples
from snakesim_hal.wire.messages import Fault, JointMode, LifecycleState
from snakesim_testing.contract.bench import TorqueSwitch

# Resolution of the setpoints and measurements of `BusWorkbench`.
ANGLE_DECIMALS = 4  # of rad
VELOCITY_DECIMALS = 3  # of rad/s
TORQUE_DECIMALS = 3  # of N·m
TORQUE_LIMIT_DECIMALS = 2  # of N·m

DOCS = Path(__file__).parents[2] / "docs" / "hardware" / "write-a-backend.md"


def read_example_from_docs() -> str:
    """Return the text of the Python file in the documentation."""
    example_block = re.search(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)
    assert example_block is not None
    return example_block[1]


example: Any = ModuleType("workbench_of_the_docs")
sys.modules[example.__name__] = example  # msgspec looks up the annotations of the example here
exec(compile(read_example_from_docs(), str(DOCS), "exec"), example.__dict__)
Workbench: Any = example.Workbench
mute: Any = example.mute


class DrivesWorkbench(Workbench):
    """A workbench whose drives have a watchdog, and are enabled only by arming."""

    WATCHDOG_S = 0.1

    def __init__(self, config: Any, settings: Any) -> None:
        super().__init__(config, settings)
        joints = len(self.angle)
        self.enabled = np.zeros(joints, dtype=bool)
        self.tripped = np.zeros(
            joints, dtype=bool
        )  # the watchdog has stopped the drive, until a reset
        self.reported = np.zeros(joints, dtype=bool)
        self.braked_s = 0.0  # time since the last armed period
        self.previous_lifecycle: LifecycleState = "disarmed"

    def enact(self, setpoints: SafeSetpoints, lifecycle: LifecycleState) -> None:
        was_latched = self.previous_lifecycle in LATCHED_STATES
        self.previous_lifecycle = lifecycle
        if was_latched and lifecycle not in LATCHED_STATES:
            self.tripped[:] = False
            self.reported[:] = False
        match lifecycle:
            case "armed":
                self.enabled = self.may_be_enabled()
                self.braked_s = 0.0
            case "fault":
                self.enabled = self.still_brakes()
            case _:
                self.enabled[:] = False
        modes = [
            mode if on else JointMode.PASSIVE
            for mode, on in zip(setpoints.mode, self.enabled, strict=True)
        ]
        super().enact(dataclasses.replace(setpoints, mode=modes), lifecycle)

    def may_be_enabled(self) -> Any:
        """Return (joints,) whether each drive may be enabled."""
        return ~self.tripped

    def still_brakes(self) -> Any:
        """Return (joints,) whether each drive still brakes its joint after a fault."""
        moves = np.abs(self.velocity) > AT_REST_SPEED_RAD_S
        return self.enabled & moves & (self.braked_s < self.WATCHDOG_S)

    def advance(self) -> None:
        super().advance()
        self.braked_s += self.steps * example.STEP_S

    def faults(self) -> list[Fault]:
        newly_tripped = self.tripped & ~self.reported
        self.reported |= newly_tripped
        names = [
            joint.name
            for joint, is_new in zip(self.description.joints, newly_tripped, strict=True)
            if is_new
        ]
        return [
            Fault(tick=0, what="drive_fault", cause=f"{name}: its watchdog", joint=name)
            for name in names
        ]


class WorkbenchDrives:
    """The drives of a `DrivesWorkbench`, and a log of their torque switches."""

    def __init__(self, backend: Any) -> None:
        self._backend = backend
        self._steps = 0
        self._is_on = self.list_enabled()
        self._log: list[TorqueSwitch] = []
        step = backend.step

        def step_and_log() -> None:
            step()
            self._steps += 1
            for joint, is_on in enumerate(self.list_enabled()):
                if is_on != self._is_on[joint]:
                    self._log.append(TorqueSwitch(self.read_time_s(), joint, is_on=is_on))
            self._is_on = self.list_enabled()

        backend.step = step_and_log

    def read_time_s(self) -> float:
        return self._steps * example.STEP_S

    def list_torque_switches(self) -> list[TorqueSwitch]:
        return list(self._log)

    def list_enabled(self) -> list[bool]:
        return self._backend.enabled.tolist()

    def freeze_driver(self, seconds: float, sleep: Any) -> None:
        backend = self._backend
        sleep(seconds)
        if seconds > backend.WATCHDOG_S:
            backend.tripped |= backend.enabled
            backend.enabled &= False
            backend.mode[:] = JointMode.PASSIVE
        for _ in range(round(seconds / example.STEP_S)):
            backend.step()


class BusWorkbench(DrivesWorkbench):
    """A robot whose commands and measurements pass a simulated bus.

    Setpoints are applied one period late, and odd joints report their measurements one period late. Numbers are rounded
    as in frames. After arming, the joints start to follow one after another.
    """

    WAKE_UP_PERIODS = (
        4  # from arming until joint 0 follows; each further joint needs one period more
    )
    # Whether the first sample has values of the odd joints, too. In lockstep it must: time is paused until the robot is
    # armed, and arming needs the state of every joint.
    KNOWS_LATE_JOINTS_AT_FIRST = True

    def __init__(self, config: Any, settings: Any) -> None:
        super().__init__(config, settings)
        joints = len(self.angle)
        self.setpoints_on_bus: SafeSetpoints | None = None
        self.lifecycle: LifecycleState = "disarmed"
        self.armed_periods = 0
        self.sample_count = 0
        # Angles, velocities and torques of all joints, as they were measured one period ago.
        self.previous_values = (np.zeros(joints), np.zeros(joints), np.zeros(joints))

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """Apply the commands that are on the bus, then measure. Joints with an odd index report one period late.

        A late joint has the value of the previous period and a higher age. At the first sample there is no previous
        period: then the joint has its current value, or is not valid.

        Args:
            tick: Number of the control cycle.
            timestamp_ns: The robot's time.
        """
        self._apply_commands_on_bus()
        fresh = super().sample(tick, timestamp_ns).joints
        measured = (
            np.round(fresh.angle_rad, ANGLE_DECIMALS),
            np.round(fresh.velocity_rad_s, VELOCITY_DECIMALS),
            np.round(fresh.torque_nm, TORQUE_DECIMALS),
        )
        is_late = np.arange(len(self.angle)) % 2 == 1
        is_first_sample = self.sample_count == 0
        if is_first_sample and self.KNOWS_LATE_JOINTS_AT_FIRST:
            self.previous_values = measured
        angle_rad, velocity_rad_s, torque_nm = (
            np.where(is_late, previous, present).tolist()
            for previous, present in zip(self.previous_values, measured, strict=True)
        )
        self.previous_values = measured
        self.sample_count += 1

        delay_ns = self.description.period_ns * is_late
        has_late_values = self.KNOWS_LATE_JOINTS_AT_FIRST or not is_first_sample
        joints = msgspec.structs.replace(
            fresh,
            angle_rad=angle_rad,
            velocity_rad_s=velocity_rad_s,
            torque_nm=torque_nm,
            age_ns=(np.array(fresh.age_ns) + delay_ns).tolist(),
            valid=[has_late_values or not late for late in is_late],
        )
        return Samples(joints)

    def _apply_commands_on_bus(self) -> None:
        """Apply the newest setpoints. A joint stays passive until its wake-up time after arming has passed."""
        if self.setpoints_on_bus is None:
            return
        super().enact(self.setpoints_on_bus, self.lifecycle)
        self.limit = np.round(self.limit, TORQUE_LIMIT_DECIMALS)
        if self.lifecycle != "armed":
            self.armed_periods = 0
            return
        self.armed_periods += 1
        # (joints,) periods from arming until each joint follows.
        wake_up_periods = self.WAKE_UP_PERIODS + np.arange(len(self.angle))
        self.mode = np.where(
            self.armed_periods < wake_up_periods, int(JointMode.PASSIVE), self.mode
        )

    def enact(self, setpoints: SafeSetpoints, lifecycle: LifecycleState) -> None:
        """Keep the setpoints on the bus until the next sample applies them."""
        if not self.open:
            super().enact(setpoints, lifecycle)
        self.setpoints_on_bus = setpoints
        self.lifecycle = lifecycle


class RealTimeWorkbench(BusWorkbench):
    """A robot on a bus in real time, whose first sample has no valid values of the odd joints."""

    KNOWS_LATE_JOINTS_AT_FIRST = False

    @classmethod
    def check(cls, config: Any, settings: Any) -> Any:
        """Return the clock modes that this backend has."""
        return ("realtime",)
