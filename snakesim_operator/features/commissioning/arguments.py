"""Arguments of `snakesim joints`."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from snakesim_hal.programs.arguments import add_network, number_type
from snakesim_operator.base.robot_selection import select_robots
from snakesim_operator.features.commissioning.tolerances import ALLOWED_BACKLASH_RAD

TASK = "scenarios, robots, labs"  # the heading of `snakesim --help` that lists it
JOG = (
    "Move one joint slowly, while a key is held; the motors of the others stay off. It arms the robot, checked or not."
)
FILE = "the robot file that the host was started with; the values are written into it"


def add_commands(commands: Any) -> None:
    """Add `joints` to the parser of `snakesim`."""
    joints = commands.add_parser("joints", help="find zeros, directions and limits of joints, and write them down")
    verbs = joints.add_subparsers(dest="verb", required=True, metavar="VERB")
    zero = _add_by_hand(verbs, "zero", _zero, "take the present pose, which must be straight, as zero of every joint")
    zero.add_argument("--now", action="store_true", help="do not wait for Enter: it lies straight")
    direction_help = "turn joints by hand: which count the wrong way round, or have another's id"
    _add_joint_names(_add_by_hand(verbs, "direction", _direction, direction_help))
    limits_help = "move joints by hand from end to end: their limits"
    _add_joint_names(_add_by_hand(verbs, "limits", _limits, limits_help))
    gear_help = "turn joints by hand by a known angle: whether their gears are as the file says"
    gear = _add_by_hand(verbs, "gear", _gear, gear_help)
    _add_joint_names(gear)
    gear.add_argument(
        "--degrees",
        type=number_type(10.0, 180.0, "degrees"),
        default=45.0,
        help="by which you turn each joint, along a template or a set square (default: 45)",
    )
    _add_jog(verbs)
    _add_check(verbs)


def _add_joint_names(command: argparse.ArgumentParser) -> None:
    command.add_argument("joints", nargs="*", metavar="JOINT", help="such as joint_3; all of them without")


def _add_check(verbs: Any) -> None:
    check = verbs.add_parser(
        "check",
        help="judge a run of `snakesim run joint_check`: signs, gears, backlash, ids, zeros, dead joints",
        epilog="Exit code: 0 sign, order, zero and gear of every joint were confirmed, 1 one is wrong or unknown, "
        "2 wrong input.",
    )
    check.add_argument("run", type=Path, help="folder of the run")
    check.add_argument(
        "file",
        type=Path,
        nargs="?",
        metavar="FILE",
        help="your robot file: write into it that it was checked, if all of it was confirmed",
    )
    check.add_argument(
        "--by-hand",
        action="store_true",
        help="you turned the joints whose sign and order it cannot judge with `joints direction`, and they are right",
    )
    check.add_argument(
        "--gear-by-hand",
        action="store_true",
        help="you measured the gears that it cannot judge with `joints gear`, they are right, and have no backlash",
    )
    check.add_argument("--straight", action="store_true", help="the robot lay straight at its start: judge all zeros")
    check.add_argument(
        "--allow-backlash",
        type=number_type(0.0, 0.5, "rad"),
        default=ALLOWED_BACKLASH_RAD,
        metavar="RAD",
        help=f"as much may be lost in a gear when its load reverses (default: {ALLOWED_BACKLASH_RAD:g} rad)",
    )
    check.set_defaults(act=_check)


def _add_jog(verbs: Any) -> None:
    jog = verbs.add_parser("jog", help="move one joint slowly, while a key is held", description=JOG)
    jog.add_argument("file", type=Path, metavar="FILE", help=FILE.partition(";")[0])
    jog.add_argument("joint", metavar="JOINT", help="such as joint_3")
    jog.add_argument("--speed", type=float, default=0.1, metavar="RAD_S", help="at most 0.5 rad/s (default: 0.1)")
    jog.add_argument("--travel", type=float, default=0.2, metavar="RAD", help="to either side (default: 0.2 rad)")
    jog.add_argument("--torque", type=float, default=0.3, metavar="SHARE", help="of the joint's limit (default: 0.3)")
    add_network(jog)
    jog.set_defaults(act=_jog)


def _add_by_hand(
    verbs: Any, verb: str, act: Callable[[argparse.Namespace], int], help_text: str
) -> argparse.ArgumentParser:
    """Add a verb for which a person moves the robot by hand."""
    command = verbs.add_parser(verb, help=help_text, description=f"{help_text.capitalize()}. The motors stay off.")
    command.add_argument("file", type=Path, metavar="FILE", help=FILE)
    add_network(command)
    command.set_defaults(act=act)
    return command


def _zero(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.by_hand import zero

    return zero(arguments.file, select_robots(arguments), wait_for_enter=not arguments.now)


def _jog(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.jog import JogRequest, jog

    request = JogRequest(
        joint=arguments.joint, speed_rad_s=arguments.speed, travel_rad=arguments.travel, torque=arguments.torque
    )
    return jog(arguments.file, select_robots(arguments), request)


def _direction(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.by_hand import direction

    return direction(arguments.file, select_robots(arguments), arguments.joints)


def _limits(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.by_hand import limits

    return limits(arguments.file, select_robots(arguments), arguments.joints)


def _gear(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.by_hand import gear

    return gear(arguments.file, select_robots(arguments), arguments.joints, arguments.degrees)


def _check(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.check import CheckRequest, check

    request = CheckRequest(
        straight=arguments.straight,
        direction_by_hand=arguments.by_hand,
        gear_by_hand=arguments.gear_by_hand,
        allowed_backlash_rad=arguments.allow_backlash,
    )
    return check(arguments.run, arguments.file, request)
