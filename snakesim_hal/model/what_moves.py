"""Whether something real moves: said in the same words by every program that a person watches a robot with."""

from snakesim_hal.wire.messages import Description

EMULATED = "EMULATED"
REAL = "REAL"
UNKNOWN = "UNKNOWN"


def describe_what_moves(robot: Description | None) -> str:
    """Returns one of the three words above, and what it means.

    robot: as its host describes it. None: no description arrived, and then a real robot cannot be excluded.
    """
    if robot is None:
        return f"{UNKNOWN} whether motors move: the host has not described the robot; treat it as a real one"
    where = f"backend {robot.backend}"
    if robot.hardware:
        where += f" on {robot.hardware}"
    if robot.emulated:
        return f"{EMULATED}: nothing real moves ({where})"
    return f"{REAL}: motors move ({where})"
