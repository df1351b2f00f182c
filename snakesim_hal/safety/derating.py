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
from snakesim_hal.wire.messages import Fault, JointDescription, Power, RobotDescription

UNDERVOLTAGE_DELAY_NS = 50_000_000  # shorter dips, as when motors start, stop nothing
# Values of an older report are unknown; modules report about twice a second.
REPORT_TIMEOUT_NS = 3_000_000_000
MAX_CAUSE_LENGTH = 400  # characters; a fault's cause has at most 500
# Ends messages about a low supply.
WHERE_TO_SET_MIN_VOLTAGE = "`min_voltage_v` under [limits] in the robot file"


class HealthMonitor:
    """What is left of each joint's torque limit, and the faults of heat, supply and leaks, from power samples."""

    def __init__(self, description: RobotDescription, *, awaits_reports: bool) -> None:
        """Start without derating and without a report.

        Args:
            description: Robot as its backend describes it: joints, with their temperature and voltage limits.
            awaits_reports: Whether arming waits until every module has reported its supply. Must be False if time is
                paused until the arming.
        """
        self._robot = description.robot
        self._awaits_reports = awaits_reports
        self._has_power_sensor = any(sensor.key == keys.POWER for sensor in description.sensors)
        self._module_healths = [_LastReport(joint) for joint in description.joints]
        self._first_evaluation_ns: int | None = None
        self._next_evaluation_ns = -math.inf  # before this time nothing changes without a sample
        # Of the last evaluation: name and joint of each.
        self._last_faults: set[tuple[str, str | None]] = set()
        self._silent_joints: set[str] = set()  # names of joints whose reports are overdue
        # (n_joints,), fraction of each torque limit that derating leaves.
        self.torque_fraction: Floats = np.ones(len(self._module_healths))
        self.current_faults: list[Fault] = []

    def update(self, power: Power, now_ns: int) -> None:
        """Store the valid entries of a power sample. A sample for another number of joints is ignored.

        Args:
            power: Newest power sample.
            now_ns: Safety time in ns.
        """
        columns = (power.voltage_v, power.motor_c, power.leak, power.valid)
        if {len(values) for values in columns} != {len(self._module_healths)}:
            return
        for health, voltage_v, winding_temperature_c, has_leak, is_valid in zip(
            self._module_healths, *columns, strict=True
        ):
            if is_valid and math.isfinite(voltage_v) and math.isfinite(winding_temperature_c):
                health.update(voltage_v, winding_temperature_c, has_leak, now_ns)
        self._next_evaluation_ns = -math.inf

    def evaluate(self, now_ns: int, tick: int) -> tuple[list[Fault], Fault | None]:
        """Update `torque_fraction` and `current_faults` from the reports of all modules and from the time.

        Args:
            now_ns: Safety time in ns.
            tick: Current tick, which new faults name.

        Returns:
            The faults that are new since the last call, and a fault that names the joints whose reports have become
            overdue since then. None if there are no such joints.
        """
        if now_ns < self._next_evaluation_ns:
            return [], None
        if self._first_evaluation_ns is None:
            self._first_evaluation_ns = now_ns
        first_evaluation_ns = self._first_evaluation_ns
        # `update` resets this time, so that a new sample is evaluated at once.
        next_change_ns = min(
            health.find_next_change_ns(now_ns, first_evaluation_ns)
            for health in self._module_healths
        )
        self._next_evaluation_ns = min(next_change_ns, now_ns + REPORT_TIMEOUT_NS)
        self.torque_fraction = np.array(
            [health.compute_torque_fraction(now_ns) for health in self._module_healths]
        )
        self.current_faults = []
        for health in self._module_healths:
            self.current_faults += health.find_faults(now_ns, tick)
        previous_faults = self._last_faults
        self._last_faults = {(fault.what, fault.joint) for fault in self.current_faults}
        new_faults = [
            fault
            for fault in self.current_faults
            if (fault.what, fault.joint) not in previous_faults
        ]
        return new_faults, self._make_silence_fault(now_ns, tick, first_evaluation_ns)

    def find_supply_problems(self, now_ns: int) -> list[str]:
        """Return a text for each problem of the supply that prevents arming, with the remedy."""
        problems: list[str] = []
        low: list[_LastReport] = []
        for health in self._module_healths:
            if health.has_recent_report(now_ns) and health.undervoltage_since_ns is not None:
                low.append(health)
        if low:
            weakest = min(low, key=lambda health: health.voltage_v)
            problems.append(
                f"the supply is at {weakest.voltage_v:.1f} V at {weakest.joint.name}, which needs "
                f"{weakest.joint.min_voltage_v:g} V{_format_others(len(low) - 1)}: check the supply, or set "
                f"{WHERE_TO_SET_MIN_VOLTAGE} of {self._robot!r}"
            )
        if self._awaits_reports and self._has_power_sensor:
            missing = self._find_unreported_joints()
            if missing:
                problems.append(
                    f"{missing[0]} has not reported its supply yet{_format_others(len(missing) - 1)}"
                )
        return problems

    def find_derated_joints(self) -> dict[str, float]:
        """Return the fraction of the torque limit that derating leaves, by the name of each derated joint."""
        fractions = zip(self._module_healths, self.torque_fraction.tolist(), strict=True)
        return {health.joint.name: fraction for health, fraction in fractions if fraction < 1.0}

    def _find_unreported_joints(self) -> list[str]:
        """Return the names of joints that have never reported, unless a fault has named them already."""
        names = [
            health.joint.name for health in self._module_healths if health.last_report_ns is None
        ]
        return [name for name in names if name not in self._silent_joints]

    def _make_silence_fault(self, now_ns: int, tick: int, first_evaluation_ns: int) -> Fault | None:
        """Return a fault that names the joints whose reports have become overdue since the last evaluation."""
        expected_since_ns = None
        if self._has_power_sensor:
            expected_since_ns = first_evaluation_ns
        silent = [
            health.joint.name
            for health in self._module_healths
            if health.is_silent(now_ns, expected_since_ns)
        ]
        previously_silent = self._silent_joints
        self._silent_joints = set(silent)
        newly_silent = [name for name in silent if name not in previously_silent]
        if not newly_silent:
            return None
        cause = f"supply and heat are unknown, and ignored, for {', '.join(newly_silent)}"[
            :MAX_CAUSE_LENGTH
        ]
        joint = None
        if len(newly_silent) == 1:
            joint = newly_silent[0]
        return Fault(tick=tick, what="power_unknown", cause=cause, joint=joint)


def _format_others(count: int) -> str:
    return f", and {count} more" if count else ""


@dataclass
class _LastReport:
    """The last report of one joint module."""

    joint: JointDescription
    last_report_ns: int | None = None
    winding_temperature_c: float = 0.0
    voltage_v: float = 0.0
    has_leak: bool = False
    # Start of the time with a too low voltage; None if the voltage is high.
    undervoltage_since_ns: int | None = None
    is_overheated: bool = False  # the winding was too hot, and has not cooled down yet

    def update(
        self, voltage_v: float, winding_temperature_c: float, has_leak: bool, now_ns: int
    ) -> None:
        """Store a valid entry of a power sample."""
        if "temperature" not in self.joint.measures:
            # The value is meaningless, and must never count as hot.
            winding_temperature_c = -math.inf
        self.last_report_ns = now_ns
        self.voltage_v = voltage_v
        self.winding_temperature_c = winding_temperature_c
        self.has_leak = has_leak
        # Hysteresis: an overheated winding stays overheated until it has cooled below `derate_from_c`.
        threshold_c = self.joint.derate_from_c if self.is_overheated else self.joint.stop_at_c
        self.is_overheated = winding_temperature_c >= threshold_c
        if "voltage" not in self.joint.measures or voltage_v >= self.joint.min_voltage_v:
            self.undervoltage_since_ns = None
        elif self.undervoltage_since_ns is None:
            self.undervoltage_since_ns = now_ns

    def has_recent_report(self, now_ns: int) -> bool:
        """Return whether the last report is recent."""
        return self.last_report_ns is not None and now_ns - self.last_report_ns <= REPORT_TIMEOUT_NS

    def is_silent(self, now_ns: int, expected_since_ns: int | None) -> bool:
        """Return whether a report is overdue.

        Args:
            now_ns: Safety time in ns.
            expected_since_ns: Time from which a first report is expected. None for a robot without a power sensor.
        """
        since_ns = self.last_report_ns
        if since_ns is None:
            since_ns = expected_since_ns
        return since_ns is not None and now_ns - since_ns > REPORT_TIMEOUT_NS

    def find_next_change_ns(self, now_ns: int, first_evaluation_ns: int) -> float:
        """Return the safety time at which the health next changes without a new report; infinity for never."""
        since_ns = first_evaluation_ns if self.last_report_ns is None else self.last_report_ns
        changes_ns = [since_ns + REPORT_TIMEOUT_NS + 1]
        if self.undervoltage_since_ns is not None:
            changes_ns.append(self.undervoltage_since_ns + UNDERVOLTAGE_DELAY_NS)
        return min((change_ns for change_ns in changes_ns if change_ns > now_ns), default=math.inf)

    def compute_torque_fraction(self, now_ns: int) -> float:
        """Return the fraction of the torque limit that is left after derating, from 0 to 1."""
        if not self.has_recent_report(now_ns):
            return 1.0
        return HeatLimits(
            self.joint.derate_from_c, self.joint.stop_at_c
        ).compute_remaining_fraction(self.winding_temperature_c)

    def find_faults(self, now_ns: int, tick: int) -> list[Fault]:
        """Return the current faults of the module: overheating of the joint, a leak, and undervoltage.

        A leak and undervoltage are faults of the whole robot. They count only if the last report is recent.

        Args:
            now_ns: Safety time in ns.
            tick: Current tick, which the faults name.
        """
        joint = self.joint
        faults: list[Fault] = []
        if self.is_overheated:
            cause = (
                f"the winding of {joint.name} is at {self.winding_temperature_c:.1f} °C; "
                f"the limit is {joint.stop_at_c:g} °C, and it must cool below {joint.derate_from_c:g} °C"
            )
            faults.append(
                Fault(tick=tick, what="overheated", cause=cause, joint=joint.name, scope="joint")
            )
        if not self.has_recent_report(now_ns):
            return faults
        if self.has_leak:
            cause = f"{joint.name} reports water inside"
            faults.append(
                Fault(tick=tick, what="leak", cause=cause, joint=joint.name, scope="robot")
            )
        if self._is_undervoltage_confirmed(now_ns):
            cause = (
                f"the supply of {joint.name} is at {self.voltage_v:.1f} V, "
                f"it needs {joint.min_voltage_v:g} V: {WHERE_TO_SET_MIN_VOLTAGE}"
            )
            faults.append(
                Fault(tick=tick, what="undervoltage", cause=cause, joint=joint.name, scope="robot")
            )
        return faults

    def _is_undervoltage_confirmed(self, now_ns: int) -> bool:
        """Return whether the voltage has been too low for at least UNDERVOLTAGE_DELAY_NS."""
        return (
            self.undervoltage_since_ns is not None
            and now_ns - self.undervoltage_since_ns >= UNDERVOLTAGE_DELAY_NS
        )
