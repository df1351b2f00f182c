"""Heat, supply and leaks: torque is derated before the robot is stopped. Pure; time is passed in.

From `derate_from_c` on the torque limit falls linearly, to a fifth at `stop_at_c`: by `thermal.HeatLimits`, which
the motors apply themselves as well. At `stop_at_c`, with water inside, or with a supply below `min_voltage_v` for
50 ms, the robot is stopped, and cannot be armed before the winding has cooled below `derate_from_c`. Heat concerns
only its joint; a leak or a weak supply concerns the whole robot. It is not armed with a weak supply, however short it
has been weak, nor in real time before every module has reported its supply. Values that a module has not reported for
some seconds are unknown: this is noted, and they are ignored.
"""

import math
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.physics.thermal import HeatLimits
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Description, Fault, JointDescription, Power

UNDERVOLTAGE_DELAY_NS = 50_000_000  # shorter dips, as when motors start, stop nothing
REPORT_TIMEOUT_NS = 3_000_000_000  # values of an older report are unknown; modules report about twice a second
MAX_CAUSE_LENGTH = 400  # characters; a fault's cause has at most 500
MIN_VOLTAGE_FIELD = "`min_voltage_v` under [limits] in the robot file"


class Derating:
    """What is left of each joint's torque limit, and the faults of heat, supply and leaks, from power samples."""

    def __init__(self, description: Description, *, awaits_reports: bool) -> None:
        """Start with all torque and without a report.

        Args:
            description: the robot as its backend describes it: joints, their limits, and the lease term.
            awaits_reports: whether arming waits until every module has reported its supply. It must not where time
                is paused until the arming.
        """
        self._robot = description.robot
        self._awaits_reports = awaits_reports
        self._has_power_sensor = any(sensor.key == keys.POWER for sensor in description.sensors)
        self._healths = [_Health(joint) for joint in description.joints]
        self._began_ns: int | None = None  # time of the first evaluation
        self._due_ns = -math.inf  # before that nothing changes without a sample
        self._reported: set[tuple[str, str | None]] = set()  # present faults, by word and joint
        self._silent: set[str] = set()  # names of joints whose reports are overdue
        self.torque_fraction: Floats = np.ones(len(self._healths))  # (n_joints,), what is left of each torque limit
        self.present_faults: list[Fault] = []

    def update(self, power: Power, now_ns: int) -> None:
        """Process a sample. Invalid entries are ignored, and so is a sample of another number of joints."""
        lists = (power.voltage_v, power.motor_c, power.leak, power.valid)
        if {len(values) for values in lists} != {len(self._healths)}:
            return
        for health, voltage_v, winding_c, leak, valid in zip(self._healths, *lists, strict=True):
            if valid and math.isfinite(voltage_v) and math.isfinite(winding_c):
                health.update(voltage_v, winding_c, leak, now_ns)
        self._due_ns = -math.inf

    def evaluate(self, now_ns: int, tick: int) -> tuple[list[Fault], Fault | None]:
        """Update `torque_fraction` and `present_faults`.

        Returns:
            The faults that are new, and a note of the joints that have just become silent.
        """
        if now_ns < self._due_ns:
            return [], None
        if self._began_ns is None:
            self._began_ns = now_ns
        began_ns = self._began_ns
        next_change_ns = min(health.next_change_ns(now_ns, began_ns) for health in self._healths)
        self._due_ns = min(next_change_ns, now_ns + REPORT_TIMEOUT_NS)
        self.torque_fraction = np.array([health.torque_fraction(now_ns) for health in self._healths])
        self.present_faults = []
        for health in self._healths:
            self.present_faults += health.find_faults(now_ns, tick)
        reported_before = self._reported
        self._reported = {(fault.what, fault.joint) for fault in self.present_faults}
        new_faults = [fault for fault in self.present_faults if (fault.what, fault.joint) not in reported_before]
        return new_faults, self._note_newly_silent(now_ns, tick, began_ns)

    def find_supply_problems(self, now_ns: int) -> list[str]:
        """Return what to do about the supply before the robot can be armed; empty if there is nothing to do."""
        problems: list[str] = []
        low = [health for health in self._healths if health.is_known(now_ns) and health.low_since_ns is not None]
        if low:
            weakest = min(low, key=lambda health: health.voltage_v)
            problems.append(
                f"the supply is at {weakest.voltage_v:.1f} V at {weakest.joint.name}, which needs "
                f"{weakest.joint.min_voltage_v:g} V{_and_others(len(low) - 1)}: check the supply, or set "
                f"{MIN_VOLTAGE_FIELD} of {self._robot!r}"
            )
        if self._awaits_reports and self._has_power_sensor:
            missing = self._find_unreported_joints()
            if missing:
                problems.append(f"{missing[0]} has not reported its supply yet{_and_others(len(missing) - 1)}")
        return problems

    def derated_joints(self) -> dict[str, float]:
        """Return the names of derated joints, with the fraction of their torque that is left."""
        fractions = zip(self._healths, self.torque_fraction.tolist(), strict=True)
        return {health.joint.name: fraction for health, fraction in fractions if fraction < 1.0}

    def _find_unreported_joints(self) -> list[str]:
        """Return the names of joints that have never reported, unless their silence has been noted already."""
        names = [health.joint.name for health in self._healths if health.reported_ns is None]
        return [name for name in names if name not in self._silent]

    def _note_newly_silent(self, now_ns: int, tick: int, began_ns: int) -> Fault | None:
        """Return a note that names the joints whose reports have become overdue since the last evaluation."""
        expected_since_ns = None
        if self._has_power_sensor:
            expected_since_ns = began_ns
        silent = [health.joint.name for health in self._healths if health.is_silent(now_ns, expected_since_ns)]
        silent_before = self._silent
        self._silent = set(silent)
        new = [name for name in silent if name not in silent_before]
        if not new:
            return None
        cause = f"supply and heat are unknown, and ignored, for {', '.join(new)}"[:MAX_CAUSE_LENGTH]
        joint = None
        if len(new) == 1:
            joint = new[0]
        return Fault(tick=tick, what="power_unknown", cause=cause, joint=joint)


def _and_others(count: int) -> str:
    return f", and {count} more" if count else ""


@dataclass
class _Health:
    """The last report of one joint module."""

    joint: JointDescription
    reported_ns: int | None = None
    winding_c: float = 0.0
    voltage_v: float = 0.0
    leak: bool = False
    low_since_ns: int | None = None  # since when the voltage has been too low; None: it is not
    hot: bool = False  # it was too hot, and has not cooled down yet

    def update(self, voltage_v: float, winding_c: float, leak: bool, now_ns: int) -> None:
        """Process a valid entry of a sample."""
        if "temperature" not in self.joint.measures:
            winding_c = -math.inf
        self.reported_ns = now_ns
        self.voltage_v = voltage_v
        self.winding_c = winding_c
        self.leak = leak
        # Hysteresis: what was too hot stays so until it has cooled below `derate_from_c`.
        threshold_c = self.joint.derate_from_c if self.hot else self.joint.stop_at_c
        self.hot = winding_c >= threshold_c
        if "voltage" not in self.joint.measures or voltage_v >= self.joint.min_voltage_v:
            self.low_since_ns = None
        elif self.low_since_ns is None:
            self.low_since_ns = now_ns

    def is_known(self, now_ns: int) -> bool:
        """Return whether the last report is recent."""
        return self.reported_ns is not None and now_ns - self.reported_ns <= REPORT_TIMEOUT_NS

    def is_silent(self, now_ns: int, expected_since_ns: int | None) -> bool:
        """Return whether a report is overdue. `expected_since_ns` is None for a robot without a power sensor."""
        since_ns = self.reported_ns
        if since_ns is None:
            since_ns = expected_since_ns
        return since_ns is not None and now_ns - since_ns > REPORT_TIMEOUT_NS

    def next_change_ns(self, now_ns: int, began_ns: int) -> float:
        """Return when the state next changes without a new report; infinity if it does not."""
        since_ns = began_ns if self.reported_ns is None else self.reported_ns
        changes_ns = [since_ns + REPORT_TIMEOUT_NS + 1]
        if self.low_since_ns is not None:
            changes_ns.append(self.low_since_ns + UNDERVOLTAGE_DELAY_NS)
        return min((change_ns for change_ns in changes_ns if change_ns > now_ns), default=math.inf)

    def torque_fraction(self, now_ns: int) -> float:
        """Return the fraction of the torque limit that is left after derating, from 0 to 1."""
        if not self.is_known(now_ns):
            return 1.0
        return HeatLimits(self.joint.derate_from_c, self.joint.stop_at_c).remaining_fraction(self.winding_c)

    def find_faults(self, now_ns: int, tick: int) -> list[Fault]:
        """Return the reasons to stop the robot, or only this joint if it is too hot."""
        joint = self.joint
        faults: list[Fault] = []
        if self.hot:
            limits = f"the limit is {joint.stop_at_c:g} °C, and it must cool below {joint.derate_from_c:g} °C"
            cause = f"the winding of {joint.name} is at {self.winding_c:.1f} °C; {limits}"
            faults.append(Fault(tick=tick, what="overheated", cause=cause, joint=joint.name, reach="joint"))
        if not self.is_known(now_ns):
            return faults
        if self.leak:
            cause = f"{joint.name} reports water inside"
            faults.append(Fault(tick=tick, what="leak", cause=cause, joint=joint.name, reach="robot"))
        if self.low_since_ns is not None and now_ns - self.low_since_ns >= UNDERVOLTAGE_DELAY_NS:
            needs = f"it needs {joint.min_voltage_v:g} V: {MIN_VOLTAGE_FIELD}"
            cause = f"the supply of {joint.name} is at {self.voltage_v:.1f} V, {needs}"
            faults.append(Fault(tick=tick, what="undervoltage", cause=cause, joint=joint.name, reach="robot"))
        return faults
