"""Watches a robot through faults and restarts: every stop must be explained, and no setpoint may jump."""

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
    JointState,
    RobotDescription,
    RobotStatus,
)
from verification.faults.observer import Observer

ROUNDING_RAD = 1e-6
MAX_KEPT_MESSAGES = 200  # joint states, and statuses
MAX_KEPT_CYCLES = 6  # applied commands, and clocks


class JudgingObserver(Observer):
    """An observer that judges messages when they arrive, and keeps only the newest ones."""

    def __init__(self, session: Session) -> None:
        """Start to observe the robot of a session."""
        super().__init__(session)
        self.violations: list[str] = []
        self.counts: Counter[str] = Counter()  # unreadable messages, and permitted steps
        self.controller_command_count = 0  # of the commands that were applied
        # Keys that are corrupted on purpose: what arrives there is not judged.
        self.ignored_keys: set[str] = set()
        self._robot: RobotDescription | None = None
        self._previous: AppliedCommand | None = None
        self._unjudged: list[AppliedCommand] = []

    def listen(self) -> None:
        """Judge the messages that have arrived. Commands are not kept."""
        super().listen()
        self.commands.clear()

    def on_unreadable(self, arrival: ReceivedSample, error: WireError) -> None:
        """Count the message by its key and the reason."""
        self.counts[f"{arrival.key}: {error.reason}"] += 1

    def receive(self, at_ns: int, message: Any) -> None:
        """Judge the message, and forget old ones."""
        super().receive(at_ns, message)
        match message:
            case RobotStatus():
                del self.statuses[:-MAX_KEPT_MESSAGES]
                self._judge_status(message)
            case AppliedCommand():
                del self.applied[:-MAX_KEPT_CYCLES]
                self.controller_command_count += message.sequence is not None
                self._unjudged.append(message)
            case Clock():
                del self.clocks[:-MAX_KEPT_CYCLES]
            case _:
                while len(self.joints) > MAX_KEPT_MESSAGES:
                    del self.joints[next(iter(self.joints))]
        # The joint state of a command arrives before the next command.
        while len(self._unjudged) > 1:
            self.judge_command(self._unjudged.pop(0))

    def start_over(self) -> None:
        """Forget what depends on ticks, because the ticks of another host begin at zero."""
        self.joints.clear()
        self._unjudged.clear()
        self._previous = None

    def _judge_status(self, status: RobotStatus) -> None:
        """Find a state without a reason, and a reason that contradicts the faults."""
        if not status.reason:
            self._add_violation(f"{status.lifecycle} without a reason")
        if status.lifecycle in ("fault", "estop") and not status.faults:
            self._add_violation(f"{status.lifecycle} without a fault: {status.reason}")
        for fault in status.faults:
            if not fault.cause or not fault.what:
                self._add_violation(f"a fault without a cause: {fault}")
        names_a_cause = any(fault.cause in status.reason for fault in status.faults)
        if status.lifecycle == "fault" and not names_a_cause:
            self._add_violation(
                f"in fault because {status.reason!r}, which is the cause of none of its faults"
            )
        if status.ready_to_arm and (status.lifecycle != "disarmed" or status.waiting_for):
            self._add_violation(
                f"ready to arm in {status.lifecycle}, waiting for {status.waiting_for}"
            )

    def judge_command(self, command: AppliedCommand) -> None:
        """Find position targets that jump, or are far from the measured angles."""
        previous = self._previous
        self._previous = command
        if keys.APPLIED in self.ignored_keys or keys.JOINTS in self.ignored_keys:
            self._previous = None
            return
        if self._robot is None:
            self._robot = self.get_description()
        assert len(command.mode) == len(command.target) == len(self._robot.joints)
        measured = self.joints.get(command.tick)
        if previous is not None and previous.tick != command.tick - 1:
            previous = None
        for joint_index, mode in enumerate(command.mode):
            if mode is JointMode.POSITION:
                distance_rad = _measure_distance_rad(command, measured, joint_index)
                self._judge_distance(self._robot, command, joint_index, distance_rad)
                if previous is not None and previous.mode[joint_index] is JointMode.POSITION:
                    self._judge_step(self._robot, previous, command, joint_index, distance_rad)

    def _judge_distance(
        self,
        robot: RobotDescription,
        command: AppliedCommand,
        joint_index: int,
        distance_rad: float,
    ) -> None:
        """Find a target of a controller that is too far from the measured angle."""
        joint = robot.joints[joint_index]
        is_in_range = joint.angle_min_rad < command.target[joint_index] < joint.angle_max_rad
        if command.sequence is None or not is_in_range:
            return
        if distance_rad > robot.max_step_rad + ROUNDING_RAD:
            self._add_violation(
                f"tick {command.tick}: the target of {joint.name} is {distance_rad:.3f} rad from the measured angle, "
                f"at most {robot.max_step_rad:g}"
            )

    def _judge_step(
        self,
        robot: RobotDescription,
        previous: AppliedCommand,
        command: AppliedCommand,
        joint_index: int,
        distance_rad: float,
    ) -> None:
        """Find a step between two targets that is faster than the joint may move.

        A step is permitted if the measured angle has forced it: the limiter then keeps the target at the maximum
        distance. So are steps between two setpoints of the host itself.
        """
        joint = robot.joints[joint_index]
        step_rad = abs(command.target[joint_index] - previous.target[joint_index])
        max_step_rad = joint.speed_limit_rad_s * robot.period_ns * 1e-9
        if step_rad <= max_step_rad + ROUNDING_RAD:
            return
        is_forced = abs(distance_rad - robot.max_step_rad) <= ROUNDING_RAD
        if math.isnan(distance_rad) or is_forced:
            self.counts["steps that the measured angle forced"] += 1
        elif previous.sequence is not None or command.sequence is not None:
            self._add_violation(
                f"tick {command.tick}: the target of {joint.name} jumps {step_rad:.3f} rad, "
                f"at most {max_step_rad:.3f}"
            )

    def _add_violation(self, violation: str) -> None:
        if violation not in self.violations:
            self.violations.append(violation)


def _measure_distance_rad(
    command: AppliedCommand, measured: JointState | None, joint_index: int
) -> float:
    """Return how far a target is from the measured angle; NaN if the angle is unknown."""
    if measured is None:
        return math.nan
    return abs(command.target[joint_index] - measured.angle_rad[joint_index])
