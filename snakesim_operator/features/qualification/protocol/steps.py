"""The steps of a qualification: what the operator does, and what must be measured. Pure."""

from dataclasses import dataclass
from typing import Literal

StepKey = Literal[
    "identity",
    "configuration",
    "limits",
    "motion",
    "torque",
    "watchdog",
    "freeze",
    "unplug",
    "supply",
    "estop_key",
    "estop_network",
    "estop_relay",
    "restart",
]

# Slack in addition to what the documentation states.
PERIODS_OF_SLACK = 2.0  # the last setpoint may be one period old, and its effect is seen one later
REPORT_SLACK_S = 0.06  # until a drive's own report of a change arrives
ESTOP_PERIODS = 4.0  # a request, its setpoint, and the drive's answer
FROZEN_S = 1.0  # for which the host is frozen
WATCHED_S = 1.0  # for which a drive must stay off
SUPPLY_LIMIT_S = 2.0  # drives report their supply rarely
POSITION_TOLERANCE_RAD = 0.015
SPEED_TOLERANCE = 1.25  # of the limit: a drive measures speed from few encoder counts
TORQUE_TOLERANCE = 1.2  # of the limit
TORQUE_NOISE_NM = 0.05
# Of the limit, that a blocked joint must reach, so that the limit was tested.
MIN_TORQUE_FRACTION = 0.5


@dataclass(frozen=True)
class Bounds:
    """The numbers of the criteria for one drive."""

    has_watchdog: bool
    watchdog_s: float
    period_s: float
    polling_feeds_watchdog: bool = False

    @property
    def torque_off_s(self) -> float:
        """Longest time from the last setpoint until the drive is off."""
        return self.watchdog_s + PERIODS_OF_SLACK * self.period_s + REPORT_SLACK_S

    @property
    def estop_s(self) -> float:
        """Longest time from an emergency stop until the drive is off."""
        return ESTOP_PERIODS * self.period_s + REPORT_SLACK_S


@dataclass(frozen=True)
class Step:
    """One step of the first hour."""

    key: StepKey
    title: str
    # For the person at the bench, before the robot is armed. Empty: nothing moves.
    instruction: str
    criterion: str
    criterion_without_watchdog: str = ""  # empty: the same


def describe_criterion(step: Step, bounds: Bounds) -> str:
    """Return the criterion of a step with its values and units."""
    text = step.criterion
    if not bounds.has_watchdog and step.criterion_without_watchdog:
        text = step.criterion_without_watchdog
    return text.format(
        torque_off=f"{bounds.torque_off_s:.2f} s",
        estop=f"{bounds.estop_s:.2f} s",
        supply=f"{SUPPLY_LIMIT_S:g} s",
        frozen=f"{FROZEN_S:g} s",
        watched=f"{WATCHED_S:g} s",
        position=f"{POSITION_TOLERANCE_RAD:g} rad",
        torque=f"{TORQUE_TOLERANCE:g}",
        speed=f"{SPEED_TOLERANCE:g}",
    )


STEPS = (
    Step(
        key="identity",
        title="Identity",
        instruction="",
        criterion="The drive reports its serial number and its firmware.",
    ),
    Step(
        key="configuration",
        title="Configuration, read back",
        instruction="",
        criterion="Every setting that a second program reads from the drive is as the robot file needs it.",
    ),
    Step(
        key="limits",
        title="Angle and speed limits",
        instruction="The joint moves to its upper limit. Keep hands away.",
        criterion="A target beyond the limit moves the joint at most {position} beyond it, at most {speed} times as "
        "fast as its speed limit.",
    ),
    Step(
        key="motion",
        title="Sign and units, by a tiny motion",
        instruction="The joint moves a few degrees forwards. Watch which way it turns.",
        criterion="The drive reports the commanded angle within {position}, and the shaft turns the positive way.",
    ),
    Step(
        key="torque",
        title="Torque limit",
        instruction="The motor holds the joint. You will be asked to block its shaft.",
        criterion="Against the block, torque reaches at least half of the limit and at most {torque} times the limit.",
    ),
    Step(
        key="watchdog",
        title="Watchdog: the host ends, and a second program keeps polling",
        instruction="The joint moves slowly. Keep hands away.",
        criterion="Torque is off at most {torque_off} after the host's last setpoint.",
        criterion_without_watchdog="The drive has no watchdog: it still holds {frozen} after the host's last setpoint.",
    ),
    Step(
        key="freeze",
        title="Host frozen for 1 s (SIGSTOP)",
        instruction="The joint moves slowly. Keep hands away.",
        criterion="Torque is off at most {torque_off} after the freeze. The host reports it. Without reset and arm, "
        "the drive stays off for {watched} after the host continues.",
        criterion_without_watchdog="Torque is off at most {torque_off} after the host continues, and stays off for "
        "{watched} without reset and arm.",
    ),
    Step(
        key="unplug",
        title="Bus unplugged",
        instruction="The joint moves slowly. You will be asked to unplug the bus cable from the drive.",
        criterion="Torque goes off by the watchdog, at most {torque_off} after the cut, and stays off once the bus is "
        "back. If the time of the cut is not known, torque is off {frozen} after your Enter.",
        criterion_without_watchdog="The drive is off once the bus is back, and stays off for {watched}.",
    ),
    Step(
        key="supply",
        title="Supply sags",
        instruction="The joint moves slowly. You will be asked to lower the supply.",
        criterion="The host reports a fault, and torque is off at most {supply} after the drop. If the time of the "
        "drop is not known, torque is off once the host has reported the fault.",
    ),
    Step(
        key="estop_key",
        title="Emergency stop by a key",
        instruction="The joint moves slowly. You will be asked to stop it by a key.",
        criterion="Torque is off at most {estop} after the key.",
    ),
    Step(
        key="estop_network",
        title="Emergency stop over the network",
        instruction="The joint moves slowly. Keep hands away.",
        criterion="Torque is off at most {estop} after the request.",
    ),
    Step(
        key="estop_relay",
        title="Emergency stop by the relay",
        instruction="The joint moves slowly. You will be asked to press the red button that cuts the motor supply.",
        criterion="The motor has no torque, and the drive stays off for {watched} once the supply is back.",
    ),
    Step(
        key="restart",
        title="Drive restarted while it moves",
        instruction="The joint moves slowly. You will be asked to switch the drive's supply off and on again.",
        criterion="The host reports a fault. The drive stays off for {watched} without reset and arm.",
    ),
)
