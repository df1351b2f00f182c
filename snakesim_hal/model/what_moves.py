"""Whether real motors move, in the same words for every program with which a person watches a robot."""

from snakesim_hal.wire.messages import RobotDescription

EMULATED = "EMULATED"
REAL = "REAL"
UNKNOWN = "UNKNOWN"


def describe_what_moves(robot: RobotDescription | None) -> str:
    """Describe whether real motors move: one of the words EMULATED, REAL and UNKNOWN, with an explanation.

    Args:
        robot: Description from the host. None if no description has arrived, so that a real robot cannot be excluded.
    """
    if robot is None:
        return f"{UNKNOWN} whether motors move: the host has not described the robot; treat it as a real one"
    hardware = f"backend {robot.backend}"
    if robot.hardware:
        hardware += f" on {robot.hardware}"
    watchdog_clause = describe_missing_watchdogs(robot)
    if robot.emulated:
        return f"{EMULATED}: nothing real moves ({hardware}){watchdog_clause}"
    return f"{REAL}: motors move ({hardware}){watchdog_clause}"


def describe_missing_watchdogs(robot: RobotDescription) -> str:
    """Return a clause about the joints whose drives have no watchdog; empty if every drive has one."""
    names = [joint.name for joint in robot.joints if not joint.watchdog]
    if not names:
        return ""
    clause = "no joint has a watchdog"
    if len(names) < len(robot.joints):
        clause = f"no watchdog: {', '.join(names)}"
    return f"; {clause}: it holds its last angle if the host dies, until its supply is cut"
