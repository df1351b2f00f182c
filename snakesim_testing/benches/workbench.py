"""The backend that docs/hardware/write-a-backend.md shows, and one that behaves like a robot on a bus."""

import dataclasses
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import numpy as np

from snakesim_drivers.kit.braking import AT_REST_RAD_S
from snakesim_drivers.kit.drive_backend import LATCHED_STATES
from snakesim_hal.backend import SafeSetpoints, Samples
from snakesim_hal.wire.messages import Fault, LifecycleState, Mode
from snakesim_testing.contract.bench import TorqueSwitch

# Resolution of what `BusWorkbench` sends and measures.
ANGLE_DECIMALS = 4  # of rad
VELOCITY_DECIMALS = 3  # of rad/s
TORQUE_DECIMALS = 3  # of N·m
TORQUE_LIMIT_DECIMALS = 2  # of N·m

DOCS = Path(__file__).parents[2] / "docs" / "hardware" / "write-a-backend.md"


def text_of_the_example() -> str:
    """The Python file in the documentation."""
    found = re.search(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)
    assert found is not None
    return found[1]


example: Any = ModuleType("workbench_of_the_docs")
sys.modules[example.__name__] = example  # where its annotations are looked up
exec(compile(text_of_the_example(), str(DOCS), "exec"), example.__dict__)
Workbench: Any = example.Workbench
mute: Any = example.mute


class DrivesWorkbench(Workbench):
    """With drives that stop by a watchdog of their own, and are enabled by an arming alone."""

    WATCHDOG_S = 0.1

    def __init__(self, config: Any, settings: Any) -> None:
        super().__init__(config, settings)
        joints = len(self.angle)
        self.enabled = np.zeros(joints, dtype=bool)
        self.tripped = np.zeros(joints, dtype=bool)  # by the watchdog, until a reset
        self.reported = np.zeros(joints, dtype=bool)
        self.braked_s = 0.0
        self.was: LifecycleState = "disarmed"

    def enact(self, setpoints: SafeSetpoints, lifecycle: LifecycleState) -> None:
        was_latched, self.was = self.was in LATCHED_STATES, lifecycle
        if was_latched and lifecycle not in LATCHED_STATES:
            self.tripped[:] = self.reported[:] = False
        match lifecycle:
            case "armed":
                self.enabled, self.braked_s = self.may_be_enabled(), 0.0
            case "fault":
                self.enabled = self.still_brakes()
            case _:
                self.enabled[:] = False
        modes = [mode if on else Mode.PASSIVE for mode, on in zip(setpoints.mode, self.enabled, strict=True)]
        super().enact(dataclasses.replace(setpoints, mode=modes), lifecycle)

    def may_be_enabled(self) -> Any:
        return ~self.tripped

    def still_brakes(self) -> Any:
        moves = np.abs(self.velocity) > AT_REST_RAD_S
        return self.enabled & moves & (self.braked_s < self.WATCHDOG_S)

    def advance(self) -> None:
        super().advance()
        self.braked_s += self.steps * example.STEP_S

    def faults(self) -> list[Fault]:
        fresh = self.tripped & ~self.reported
        self.reported |= fresh
        names = [joint.name for joint, is_fresh in zip(self.description.joints, fresh, strict=True) if is_fresh]
        return [Fault(tick=0, what="drive_fault", cause=f"{name}: its watchdog", joint=name) for name in names]


class WorkbenchDrives:
    """The drives of a `DrivesWorkbench`."""

    def __init__(self, backend: Any) -> None:
        self._backend = backend
        self._steps = 0
        self._is_on = self.enabled()
        self._log: list[TorqueSwitch] = []
        step = backend.step

        def step_and_log() -> None:
            step()
            self._steps += 1
            for joint, is_on in enumerate(self.enabled()):
                if is_on != self._is_on[joint]:
                    self._log.append(TorqueSwitch(self.now_s(), joint, on=is_on))
            self._is_on = self.enabled()

        backend.step = step_and_log

    def now_s(self) -> float:
        return self._steps * example.STEP_S

    def torque_log(self) -> list[TorqueSwitch]:
        return list(self._log)

    def enabled(self) -> list[bool]:
        return self._backend.enabled.tolist()

    def freeze_driver(self, seconds: float, sleep: Any) -> None:
        backend = self._backend
        sleep(seconds)
        if seconds > backend.WATCHDOG_S:
            backend.tripped |= backend.enabled
            backend.enabled &= False
            backend.mode[:] = Mode.PASSIVE
        for _ in range(round(seconds / example.STEP_S)):
            backend.step()


class BusWorkbench(DrivesWorkbench):
    """As late, coarse and slow to wake as a robot on a bus may be, and at rest by itself when it is not armed."""

    WAKES_AFTER = 4  # periods until joint 0 is armed; each further joint takes one more
    KNOWN_AT_ONCE = True  # in lockstep time is paused until arming, and arming needs to know every joint

    def __init__(self, config: Any, settings: Any) -> None:
        super().__init__(config, settings)
        joints = len(self.angle)
        self.on_its_way: SafeSetpoints | None = None
        self.lifecycle: LifecycleState = "disarmed"
        self.armed_for = 0
        self.samples = 0
        self.old = (np.zeros(joints), np.zeros(joints), np.zeros(joints))

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """Apply the commands that are on the bus, then measure. Joints with an odd index report one period late.

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
        is_first_sample = self.samples == 0
        if is_first_sample and self.KNOWN_AT_ONCE:
            self.old = measured
        angle_rad, velocity_rad_s, torque_nm = (
            np.where(is_late, previous, present).tolist() for previous, present in zip(self.old, measured, strict=True)
        )
        self.old = measured
        self.samples += 1

        delay_ns = self.description.period_ns * is_late
        has_late_values = self.KNOWN_AT_ONCE or not is_first_sample
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
        """Apply the newest setpoints; a joint that was armed only just now stays passive."""
        if self.on_its_way is None:
            return
        if self.lifecycle == "armed":
            self.armed_for += 1
        else:
            self.armed_for = 0
        wakes_after = self.WAKES_AFTER + np.arange(len(self.angle))  # periods, of every joint
        super().enact(self.on_its_way, self.lifecycle)
        self.mode = np.where(self.armed_for < wakes_after, int(Mode.PASSIVE), self.mode)
        self.limit = np.round(self.limit, TORQUE_LIMIT_DECIMALS)

    def enact(self, setpoints: SafeSetpoints, lifecycle: LifecycleState) -> None:
        """Put it on the bus."""
        if not self.open:
            super().enact(setpoints, lifecycle)
        self.on_its_way, self.lifecycle = setpoints, lifecycle


class RealTimeWorkbench(BusWorkbench):
    """And its time does not wait, nor does it know all joints at once."""

    KNOWN_AT_ONCE = False

    @classmethod
    def check(cls, config: Any, settings: Any) -> Any:
        """As a real robot."""
        return ("realtime",)
