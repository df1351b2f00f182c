"""Whether real motors move, in the same words for every program with which a person watches a robot."""

from snakesim_hal.wire.messages import Description

EMULATED = "EMULATED"
REAL = "REAL"
UNKNOWN = "UNKNOWN"


def describe_what_moves(robot: Description | None) -> str:
    """Return one of the three words above, and what it means.

    Args:
        robot: the description from the host; None: no description arrived, so a real robot cannot be excluded.
    """
    if robot is None:
        return f"{UNKNOWN} whether motors move: the host has not described the robot; treat it as a real one"
    where = f"backend {robot.backend}"
    if robot.hardware:
        where += f" on {robot.hardware}"
    unguarded = describe_missing_watchdogs(robot)
    if robot.emulated:
        return f"{EMULATED}: nothing real moves ({where}){unguarded}"
    return f"{REAL}: motors move ({where}){unguarded}"


def describe_missing_watchdogs(robot: Description) -> str:
    """Return a clause about the joints whose drives have no watchdog; empty if every drive has one."""
    names = [joint.name for joint in robot.joints if not joint.watchdog]
    if not names:
        return ""
    which = "no joint has a watchdog"
    if len(names) < len(robot.joints):
        which = f"no watchdog: {', '.join(names)}"
    return f"; {which}: it holds its last angle if the host dies, until its supply is cut"
