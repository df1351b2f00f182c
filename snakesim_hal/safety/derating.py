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

from snakesim_hal.physics.thermal import HeatLimits
from snakesim_hal.safety.limiter import Floats
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Description, Fault, JointDescription, Power

LOW_FOR_NS = 50_000_000
KNOWN_FOR_NS = 3_000_000_000
LONGEST_CAUSE = 400
FIELD = "`min_voltage_v` under [limits] in the robot file"


class Derating:
    """Torque share and health of every joint, from power samples."""

    def __init__(self, description: Description, *, awaits_reports: bool) -> None:
        """awaits_reports: before an arming; False where time may stand until then."""
        self._robot, self._awaits_reports = description.robot, awaits_reports
        self._healths = [_Health(joint) for joint in description.joints]
        self._expected = any(sensor.key == keys.POWER for sensor in description.sensors)
        self._began_ns: int | None = None
        self._due_ns = -math.inf  # before that nothing changes without a sample
        self._reported: set[tuple[str, str | None]] = set()
        self._silent: set[str] = set()
        self.share: Floats = np.ones(len(self._healths))  # of its torque limit, left to each joint
        self.wrong: list[Fault] = []  # present faults

    def take(self, power: Power, now_ns: int) -> None:
        """Take a sample; invalid entries are ignored, and so is a sample of another number of joints."""
        lists = (power.voltage_v, power.motor_c, power.leak, power.valid)
        if {len(values) for values in lists} != {len(self._healths)}:
            return
        for health, volts, winding_c, leak, valid in zip(self._healths, *lists, strict=True):
            if valid and math.isfinite(volts) and math.isfinite(winding_c):
                health.take(volts, winding_c, leak, now_ns)
        self._due_ns = -math.inf

    def look(self, now_ns: int, tick: int) -> tuple[list[Fault], Fault | None]:
        """Evaluate at `now_ns`. Returns new faults, and a note of the joints that have fallen silent."""
        if now_ns < self._due_ns:
            return [], None
        began_ns = self._began_ns = now_ns if self._began_ns is None else self._began_ns
        self._due_ns = min(min(health.due_ns(now_ns, began_ns) for health in self._healths), now_ns + KNOWN_FOR_NS)
        self.share = np.array([health.share(now_ns) for health in self._healths])
        self.wrong = [
            Fault(
                tick=tick,
                what=what,
                cause=cause,
                joint=health.joint.name,
                reach="joint" if what == "overheated" else "robot",
            )
            for health in self._healths
            for what, cause in health.failures(now_ns)
        ]
        before, self._reported = self._reported, {(fault.what, fault.joint) for fault in self.wrong}
        fresh = [fault for fault in self.wrong if (fault.what, fault.joint) not in before]
        return fresh, self._newly_silent(now_ns, tick)

    def against_arming(self, now_ns: int) -> list[str]:
        """What is to be done about the supply before the robot is armed; empty when nothing."""
        against: list[str] = []
        if low := [health for health in self._healths if health.known(now_ns) and health.low_since_ns is not None]:
            weakest = min(low, key=lambda health: health.voltage_v)
            against.append(
                f"the supply is at {weakest.voltage_v:.1f} V at {weakest.joint.name}, which needs "
                f"{weakest.joint.min_voltage_v:g} V{_and_others(len(low) - 1)}: check the supply, or set {FIELD} "
                f"of {self._robot!r}"
            )
        if self._awaits_reports and self._expected:
            unheard = [
                one.joint.name for one in self._healths if one.heard_ns is None and one.joint.name not in self._silent
            ]
            if unheard:
                against.append(f"{unheard[0]} has not reported its supply yet{_and_others(len(unheard) - 1)}")
        return against

    def derated(self) -> dict[str, float]:
        """Derated joints, and the share of their torque that is left."""
        shares = zip(self._healths, self.share.tolist(), strict=True)
        return {health.joint.name: share for health, share in shares if share < 1.0}

    def _newly_silent(self, now_ns: int, tick: int) -> Fault | None:
        before, began_ns = self._silent, self._began_ns if self._expected else None
        silent = [health.joint.name for health in self._healths if health.silent(now_ns, began_ns)]
        self._silent = set(silent)
        fresh = [name for name in silent if name not in before]
        if not fresh:
            return None
        cause = f"supply and heat are unknown, and ignored, for {', '.join(fresh)}"[:LONGEST_CAUSE]
        joint = fresh[0] if len(fresh) == 1 else None
        return Fault(tick=tick, what="power_unknown", cause=cause, joint=joint)


def _and_others(count: int) -> str:
    return f", and {count} more" if count else ""


@dataclass
class _Health:
    """The last report of one module."""

    joint: JointDescription
    heard_ns: int | None = None
    winding_c: float = 0.0
    voltage_v: float = 0.0
    leak: bool = False
    low_since_ns: int | None = None
    hot: bool = False  # it was too hot, and has not cooled down yet

    def take(self, voltage_v: float, winding_c: float, leak: bool, now_ns: int) -> None:
        """A valid entry of a sample."""
        self.heard_ns, self.voltage_v, self.winding_c, self.leak = now_ns, voltage_v, winding_c, leak
        if "temperature" not in self.joint.measures:
            self.winding_c = winding_c = -math.inf
        self.hot = winding_c >= (self.joint.derate_from_c if self.hot else self.joint.stop_at_c)
        low = "voltage" in self.joint.measures and voltage_v < self.joint.min_voltage_v
        self.low_since_ns = (now_ns if self.low_since_ns is None else self.low_since_ns) if low else None

    def known(self, now_ns: int) -> bool:
        """Whether its last report is recent."""
        return self.heard_ns is not None and now_ns - self.heard_ns <= KNOWN_FOR_NS

    def silent(self, now_ns: int, expected_since_ns: int | None) -> bool:
        """Whether its report is overdue; expected_since_ns: None when there may be no such sensor."""
        since_ns = expected_since_ns if self.heard_ns is None else self.heard_ns
        return since_ns is not None and now_ns - since_ns > KNOWN_FOR_NS

    def due_ns(self, now_ns: int, began_ns: int) -> float:
        """When its state next changes without a new report."""
        silent_ns = (began_ns if self.heard_ns is None else self.heard_ns) + KNOWN_FOR_NS + 1
        low_ns = math.inf if self.low_since_ns is None else self.low_since_ns + LOW_FOR_NS
        return min((at_ns for at_ns in (silent_ns, low_ns) if at_ns > now_ns), default=math.inf)

    def share(self, now_ns: int) -> float:
        """The share of the torque limit that is left after derating."""
        if not self.known(now_ns):
            return 1.0
        return HeatLimits(self.joint.derate_from_c, self.joint.stop_at_c).remaining_fraction(self.winding_c)

    def failures(self, now_ns: int) -> list[tuple[str, str]]:
        """Reasons to stop the robot: a word, and the full cause."""
        joint, found = self.joint, list[tuple[str, str]]()
        if self.hot:
            limits = f"the limit is {joint.stop_at_c:g} °C, and it must cool below {joint.derate_from_c:g} °C"
            found.append(("overheated", f"the winding of {joint.name} is at {self.winding_c:.1f} °C; {limits}"))
        if not self.known(now_ns):
            return found
        if self.leak:
            found.append(("leak", f"{joint.name} reports water inside"))
        if self.low_since_ns is not None and now_ns - self.low_since_ns >= LOW_FOR_NS:
            needs = f"it needs {joint.min_voltage_v:g} V: {FIELD}"
            cause = f"the supply of {joint.name} is at {self.voltage_v:.1f} V, {needs}"
            found.append(("undervoltage", cause))
        return found
