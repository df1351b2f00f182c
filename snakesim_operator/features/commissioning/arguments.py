"""The commands that calibrate, check and identify the joints of a robot: `snakesim robot calibrate`, `check`, ..."""

import argparse
from pathlib import Path

from snakesim_hal.programs.arguments import add_json, add_network, add_out, number_type
from snakesim_hal.programs.commands import Command, Commands, Noun
from snakesim_operator.base.robot_selection import select_robots
from snakesim_operator.features.commissioning.tolerances import ALLOWED_BACKLASH_RAD

FILE = "the robot file that the host was started with, into which the values are written"


def add_write(parser: argparse.ArgumentParser, about: str) -> None:
    """Add the robot file that a command changes. about: what is written, for the help."""
    parser.add_argument("--write", type=Path, metavar="FILE", help=f"your robot file: {about}")


def _add_robot_file(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of a command for which a person moves the robot by hand."""
    parser.add_argument("file", type=Path, metavar="FILE", help=FILE)
    add_network(parser)


def _add_joint_names(parser: argparse.ArgumentParser) -> None:
    _add_robot_file(parser)
    parser.add_argument("joints", nargs="*", metavar="JOINT", help="such as joint_3 (default: all joints)")


def _add_zero(parser: argparse.ArgumentParser) -> None:
    _add_robot_file(parser)
    parser.add_argument("--now", action="store_true", help="do not wait for Enter: it lies straight")


def _add_gear(parser: argparse.ArgumentParser) -> None:
    _add_joint_names(parser)
    parser.add_argument(
        "--degrees",
        type=number_type(10.0, 180.0, "degrees"),
        default=45.0,
        metavar="DEGREES",
        help="by which you turn each joint, along a template or a set square (default: 45)",
    )


def _add_jog(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE", help=FILE.partition(";")[0])
    parser.add_argument("joint", metavar="JOINT", help="such as joint_3")
    parser.add_argument(
        "--joint-speed", type=float, default=0.1, metavar="RAD/S", help="at most 0.5 rad/s (default: 0.1)"
    )
    parser.add_argument("--travel", type=float, default=0.2, metavar="RAD", help="to either side (default: 0.2 rad)")
    parser.add_argument(
        "--torque", type=float, default=0.3, metavar="FRACTION", help="of the joint's limit (default: 0.3)"
    )
    add_network(parser)


def _add_check(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snakesim robot check`, which judges how the joints of a new robot are mounted."""
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of the run")
    add_write(parser, "that it was checked is written into it, if all of it was confirmed")
    parser.add_argument(
        "--by-hand",
        action="store_true",
        help="you turned the joints whose sign and order it cannot judge with `robot calibrate direction`, and they "
        "are right",
    )
    parser.add_argument(
        "--gear-by-hand",
        action="store_true",
        help="you measured the gears that it cannot judge with `robot calibrate gear`, they are right, and have no "
        "backlash",
    )
    parser.add_argument("--straight", action="store_true", help="the robot lay straight at its start: judge all zeros")
    parser.add_argument(
        "--allow-backlash",
        type=number_type(0.0, 0.5, "rad"),
        default=ALLOWED_BACKLASH_RAD,
        metavar="RAD",
        help=f"as much may be lost in a gear when its load reverses (default: {ALLOWED_BACKLASH_RAD:g} rad)",
    )
    add_json(parser)


def _add_identify(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "run", type=Path, metavar="RUN", help="folder of the run, in which the robot was suspended by its tail"
    )
    add_write(parser, "the values are written into it")
    add_out(parser, "the page, an HTML file (default: identified.html in the run)")
    add_json(parser)


def _zero(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.by_hand import zero

    return zero(arguments.file, select_robots(arguments), wait_for_enter=not arguments.now)


def _jog(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.jog import JogRequest, jog

    request = JogRequest(
        joint=arguments.joint, speed_rad_s=arguments.joint_speed, travel_rad=arguments.travel, torque=arguments.torque
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
    return check(arguments.run, arguments.write, request, as_json=arguments.json)


def _identify(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.identify import identify

    return identify(arguments.run, arguments.write, arguments.out, as_json=arguments.json)


COMMANDS: Commands = (
    Noun(
        name="robot calibrate",
        help="Find zeros, directions, limits and gears of joints by hand, and write them down. The motors stay off.",
    ),
    Command(
        name="robot calibrate zero",
        help="Take the present pose, which must be straight, as zero of every joint.",
        add=_add_zero,
        run=_zero,
        examples=("robot calibrate zero snake.toml", "robot calibrate zero snake.toml --now"),
    ),
    Command(
        name="robot calibrate direction",
        help="Find joints that count the wrong way round or have another's id, while you turn them by hand.",
        add=_add_joint_names,
        run=_direction,
        examples=("robot calibrate direction snake.toml", "robot calibrate direction snake.toml joint_3 joint_4"),
    ),
    Command(
        name="robot calibrate limits",
        help="Find the limits of joints, while you move them by hand from end to end.",
        add=_add_joint_names,
        run=_limits,
        examples=("robot calibrate limits snake.toml", "robot calibrate limits snake.toml joint_3"),
    ),
    Command(
        name="robot calibrate gear",
        help="Find whether gear ratios match the robot file, while you turn joints by hand by a known angle.",
        add=_add_gear,
        run=_gear,
        examples=("robot calibrate gear snake.toml", "robot calibrate gear snake.toml joint_3 --degrees 90"),
    ),
    Command(
        name="robot jog",
        help="Move one joint slowly, while a key is held.",
        add=_add_jog,
        run=_jog,
        details="The motors of the other joints stay off. It arms the robot, checked or not.",
        examples=("robot jog snake.toml joint_3", "robot jog snake.toml joint_3 --joint-speed 0.05 --travel 0.1"),
    ),
    Command(
        name="robot check",
        help="Judge a run of `snakesim run joint_check`: signs, gears, backlash, ids, zeros, dead joints.",
        add=_add_check,
        run=_check,
        details="Exit code 0: sign, order, zero and gear of every joint were confirmed. 1: one is wrong or unknown. "
        "2: wrong input.",
        examples=("robot check runs/check --straight", "robot check runs/check --straight --write snake.toml"),
    ),
    Command(
        name="robot identify",
        help="Identify friction, rotor inertia, torque constant and response of joints from `snakesim run identify`.",
        add=_add_identify,
        run=_identify,
        details="Exit code 0: every joint was identified. 1: one was not, or does not move as it should. 2: wrong "
        "input.",
        examples=("robot identify runs/identify", "robot identify runs/identify --write snake.toml"),
    ),
)
