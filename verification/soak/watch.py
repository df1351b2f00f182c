"""Watches a robot through faults and restarts: whether it explains itself, and whether setpoints ever jump."""

import math
from collections import Counter
from typing import Any

from snakesim_hal.base.errors import WireError
from snakesim_hal.network.session import Session
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    AppliedCommand,
    Clock,
    JointMode,
    RobotDescription,
    RobotStatus,
)
from verification.faults.observer import Observer

ROUNDING_RAD = 1e-6
KEPT = 200  # joint states, and statuses


class JudgingObserver(Observer):
    """An observer that judges at once what it hears, and keeps little."""

    def __init__(self, session: Session) -> None:
        super().__init__(session)
        self.violations: list[str] = []
        self.counts: Counter[str] = Counter()
        self.sequences = 0  # applied commands of a controller
        # Keys that are corrupted on purpose: what comes there proves nothing.
        self.blind: set[str] = set()
        self._robot: RobotDescription | None = None
        self._before: AppliedCommand | None = None
        self._pending: list[AppliedCommand] = []

    def listen(self) -> None:
        """Take in what has come; commands are not kept."""
        super().listen()
        self.commands.clear()

    def on_unreadable(self, arrival: ReceivedSample, error: WireError) -> None:
        """It is counted, by key and reason."""
        self.counts[f"{arrival.key}: {error.reason}"] += 1

    def receive(self, at_ns: int, message: Any) -> None:
        """Judge it at once, and keep little."""
        super().receive(at_ns, message)
        match message:
            case RobotStatus():
                del self.statuses[:-KEPT]
                self._explained(message)
            case AppliedCommand():
                del self.applied[:-6]
                self.sequences += message.sequence is not None
                self._pending.append(message)
            case Clock():
                del self.clocks[:-6]
            case _:
                while len(self.joints) > KEPT:
                    del self.joints[next(iter(self.joints))]
        while len(self._pending) > 1:  # its joint state has come, if it ever will
            self.judge(self._pending.pop(0))

    def start_over(self) -> None:
        """Another host: its ticks count from zero."""
        self.joints.clear()
        self._pending.clear()
        self._before = None

    def _explained(self, status: RobotStatus) -> None:
        """A state that does not say why, or says something else."""
        if not status.reason:
            self._violated(f"{status.lifecycle} without a why")
        if status.lifecycle in ("fault", "estop") and not status.faults:
            self._violated(f"{status.lifecycle} without a fault: {status.reason}")
        for fault in status.faults:
            if not fault.cause or not fault.what:
                self._violated(f"a fault without a cause: {fault}")
        if status.lifecycle == "fault" and not any(
            fault.cause in status.reason for fault in status.faults
        ):
            self._violated(f"in fault because {status.reason!r}, which none of its faults says")
        if status.ready_to_arm and (status.lifecycle != "disarmed" or status.waiting_for):
            self._violated(f"ready to arm in {status.lifecycle}, waiting for {status.waiting_for}")

    def judge(self, now: AppliedCommand) -> None:
        """A position target that jumps, or is far from where the joint is."""
        before, self._before = self._before, now
        if keys.APPLIED in self.blind or keys.JOINTS in self.blind:
            self._before = None
            return
        if self._robot is None:
            self._robot = self.get_description()
        robot, measured = self._robot, self.joints.get(now.tick)
        follows = before is not None and before.tick == now.tick - 1
        for i, (joint, mode, target) in enumerate(
            zip(robot.joints, now.mode, now.target, strict=True)
        ):
            if mode is not JointMode.POSITION:
                continue
            edge = math.nan if measured is None else abs(target - measured.angle_rad[i])
            in_range = joint.angle_min_rad < target < joint.angle_max_rad
            if now.sequence is not None and in_range and edge > robot.max_step_rad + ROUNDING_RAD:
                most = f"at most {robot.max_step_rad:g}"
                self._violated(
                    f"tick {now.tick}: {joint.name} is sent {edge:.3f} rad away from where it is, {most}"
                )
            if not follows or before is None or before.mode[i] is not JointMode.POSITION:
                continue
            step, most = (
                abs(target - before.target[i]),
                joint.speed_limit_rad_s * robot.period_ns * 1e-9,
            )
            if step <= most + ROUNDING_RAD:
                continue
            if math.isnan(edge) or abs(edge - robot.max_step_rad) <= ROUNDING_RAD:
                self.counts["steps that the measured angle forced"] += 1
            elif before.sequence is not None or now.sequence is not None:
                self._violated(
                    f"tick {now.tick}: the target of {joint.name} jumps {step:.3f} rad, at most {most:.3f}"
                )

    def _violated(self, what: str) -> None:
        if what not in self.violations:
            self.violations.append(what)
