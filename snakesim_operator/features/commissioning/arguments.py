"""The commands that calibrate, check and identify the joints of a robot: `snakesim robot calibrate`, `check`, ..."""

import argparse
from pathlib import Path

from snakesim_hal.programs.arguments import (
    add_json_argument,
    add_network_arguments,
    add_output_argument,
    make_number_parser,
)
from snakesim_hal.programs.commands import Command, CommandGroup, Commands
from snakesim_operator.base.robot_selection import select_robots
from snakesim_operator.features.commissioning.tolerances import ALLOWED_BACKLASH_RAD

DEFAULT_DRAWING = "shapes.pdf"
MAX_WEIGHT_KG = 50.0  # that a person lays on a link
PAPER_NAMES = ("a4", "a3", "letter")
ROBOT_FILE_HELP = "the robot file that the host was started with, into which the values are written"


def add_write_option(parser: argparse.ArgumentParser, help_text: str) -> None:
    """Add the option `--write` with the robot file that a command changes.

    Args:
        parser: The parser of the command.
        about: Help text about what is written into the file.
    """
    parser.add_argument("--write", type=Path, metavar="FILE", help=f"your robot file: {help_text}")


def _add_robot_file_argument(parser: argparse.ArgumentParser) -> None:
    """Add the robot file and the network options of a command for which a person moves the robot by hand."""
    parser.add_argument("file", type=Path, metavar="FILE", help=ROBOT_FILE_HELP)
    add_network_arguments(parser)


def _add_calibrate_arguments(parser: argparse.ArgumentParser) -> None:
    _add_robot_file_argument(parser)
    parser.add_argument(
        "joints", nargs="*", metavar="JOINT", help="such as joint_3 (default: all joints)"
    )


def _add_calibrate_zero_arguments(parser: argparse.ArgumentParser) -> None:
    _add_robot_file_argument(parser)
    parser.add_argument(
        "--now", action="store_true", help="do not wait for Enter: it lies straight"
    )


def _add_calibrate_gear_arguments(parser: argparse.ArgumentParser) -> None:
    _add_calibrate_arguments(parser)
    parser.add_argument(
        "--degrees",
        type=make_number_parser(10.0, 180.0, "degrees"),
        default=45.0,
        metavar="DEGREES",
        help="by which you turn each joint, along a template or a set square (default: 45)",
    )


def _add_shape_draw_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", metavar="FILE", help="robot file, or name of a shipped one")
    add_output_argument(
        parser, f"a .pdf for a printer, or an .svg for a plotter (default: {DEFAULT_DRAWING})"
    )
    parser.add_argument(
        "--sheet-size", choices=PAPER_NAMES, default="a4", help="size of the sheets (default: a4)"
    )


def _add_jog_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE", help=ROBOT_FILE_HELP.partition(";")[0])
    parser.add_argument("joint", metavar="JOINT", help="such as joint_3")
    parser.add_argument(
        "--joint-speed",
        type=float,
        default=0.1,
        metavar="RAD/S",
        help="at most 0.5 rad/s (default: 0.1)",
    )
    parser.add_argument(
        "--travel", type=float, default=0.2, metavar="RAD", help="to either side (default: 0.2 rad)"
    )
    parser.add_argument(
        "--torque",
        type=float,
        default=0.3,
        metavar="FRACTION",
        help="of the joint's limit (default: 0.3)",
    )
    add_network_arguments(parser)


def _add_check_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snakesim robot check`, which judges how the joints of a new robot are mounted."""
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of the run")
    add_write_option(parser, "that it was checked is written into it, if all of it was confirmed")
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
    parser.add_argument(
        "--straight",
        action="store_true",
        help="the robot lay straight at its start: judge all zeros",
    )
    parser.add_argument(
        "--end-weights",
        type=make_number_parser(0.0, MAX_WEIGHT_KG, "kg"),
        default=0.0,
        metavar="KG",
        help="a weight of this mass lay on the first and on the last link: without IMUs, also judge whether the joints "
        "there are loose (default: none)",
    )
    parser.add_argument(
        "--allow-backlash",
        type=make_number_parser(0.0, 0.5, "rad"),
        default=ALLOWED_BACKLASH_RAD,
        metavar="RAD",
        help=f"as much may be lost in a gear when its load reverses (default: {ALLOWED_BACKLASH_RAD:g} rad)",
    )
    add_json_argument(parser)


def _add_identify_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "run",
        type=Path,
        metavar="RUN",
        help="folder of the run, in which the robot was suspended by its tail",
    )
    add_write_option(parser, "the values are written into it")
    add_output_argument(parser, "the page, an HTML file (default: identified.html in the run)")
    add_json_argument(parser)


def _run_calibrate_zero(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.by_hand import calibrate_zeros

    return calibrate_zeros(
        arguments.file, select_robots(arguments), wait_for_enter=not arguments.now
    )


def _run_shape_draw(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.shape.draw import draw_shapes

    return draw_shapes(arguments.file, arguments.out or Path(DEFAULT_DRAWING), arguments.sheet_size)


def _run_shape_check(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.shape.check import check_shapes

    return check_shapes(arguments.file, select_robots(arguments))


def _run_jog(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.jog import JogRequest, jog_joint

    request = JogRequest(
        joint=arguments.joint,
        speed_rad_s=arguments.joint_speed,
        travel_rad=arguments.travel,
        torque_fraction=arguments.torque,
    )
    return jog_joint(arguments.file, select_robots(arguments), request)


def _run_calibrate_direction(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.by_hand import calibrate_directions

    return calibrate_directions(arguments.file, select_robots(arguments), arguments.joints)


def _run_calibrate_limits(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.by_hand import calibrate_limits

    return calibrate_limits(arguments.file, select_robots(arguments), arguments.joints)


def _run_calibrate_gear(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.by_hand import check_gears

    return check_gears(
        arguments.file, select_robots(arguments), arguments.joints, arguments.degrees
    )


def _run_check(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.joint_check.check import (
        CheckStatement,
        report_joint_check,
    )

    request = CheckStatement(
        straight=arguments.straight,
        end_weights_kg=arguments.end_weights,
        direction_by_hand=arguments.by_hand,
        gear_by_hand=arguments.gear_by_hand,
        allowed_backlash_rad=arguments.allow_backlash,
    )
    return report_joint_check(arguments.run, arguments.write, request, as_json=arguments.json)


def _run_identify(arguments: argparse.Namespace) -> int:
    from snakesim_operator.features.commissioning.system_identification.identify import (
        identify_and_report,
    )

    return identify_and_report(
        arguments.run, arguments.write, arguments.out, as_json=arguments.json
    )


COMMANDS: Commands = (
    CommandGroup(
        name="robot calibrate",
        help="Find zeros, directions, limits and gears of joints by hand, and write them down. The motors stay off.",
    ),
    Command(
        name="robot calibrate zero",
        help="Take the present pose, which must be straight, as zero of every joint.",
        add=_add_calibrate_zero_arguments,
        run=_run_calibrate_zero,
        examples=("robot calibrate zero snake.toml", "robot calibrate zero snake.toml --now"),
    ),
    Command(
        name="robot calibrate direction",
        help="Find joints that count the wrong way round or have another's id, while you turn them by hand.",
        add=_add_calibrate_arguments,
        run=_run_calibrate_direction,
        examples=(
            "robot calibrate direction snake.toml",
            "robot calibrate direction snake.toml joint_3 joint_4",
        ),
    ),
    Command(
        name="robot calibrate limits",
        help="Find the limits of joints, while you move them by hand from end to end.",
        add=_add_calibrate_arguments,
        run=_run_calibrate_limits,
        examples=("robot calibrate limits snake.toml", "robot calibrate limits snake.toml joint_3"),
    ),
    Command(
        name="robot calibrate gear",
        help="Find whether gear ratios match the robot file, while you turn joints by hand by a known angle.",
        add=_add_calibrate_gear_arguments,
        run=_run_calibrate_gear,
        examples=(
            "robot calibrate gear snake.toml",
            "robot calibrate gear snake.toml joint_3 --degrees 90",
        ),
    ),
    CommandGroup(
        name="robot shape",
        help="Check signs, ids, gears and zeros of robots without IMUs: bend them into shapes on paper. The motors "
        "stay off.",
    ),
    Command(
        name="robot shape draw",
        help="Draw the shapes of a robot in true scale, on sheets of paper or for a plotter.",
        add=_add_shape_draw_arguments,
        run=_run_shape_draw,
        details="No robot has to run.",
        examples=("robot shape draw snake.toml", "robot shape draw snake.toml --out shapes.svg"),
    ),
    Command(
        name="robot shape check",
        help="Judge order, sign, gear and zero of every joint while you lay the robot into its shapes and shake its "
        "links.",
        add=_add_robot_file_argument,
        run=_run_shape_check,
        details="Exit code 0: all were confirmed, and recorded in the robot file. 1: one is wrong or unknown, or you "
        "do not know whether a link is loose. 2: wrong input.",
        examples=(
            "robot shape check snake.toml",
            "robot shape check snake.toml --namespace snake_2",
        ),
    ),
    Command(
        name="robot jog",
        help="Move one joint slowly, while a key is held.",
        add=_add_jog_arguments,
        run=_run_jog,
        details="The motors of the other joints stay off. It arms the robot, checked or not.",
        examples=(
            "robot jog snake.toml joint_3",
            "robot jog snake.toml joint_3 --joint-speed 0.05 --travel 0.1",
        ),
    ),
    Command(
        name="robot check",
        help="Judge a run of `snakesim run joint_check`: signs, gears, backlash, ids, zeros, dead joints.",
        add=_add_check_arguments,
        run=_run_check,
        details="Exit code 0: sign, order, zero and gear of every joint were confirmed. 1: one is wrong or unknown. "
        "2: wrong input.",
        examples=(
            "robot check runs/check --straight",
            "robot check runs/check --straight --write snake.toml",
        ),
    ),
    Command(
        name="robot identify",
        help="Identify friction, rotor inertia, torque constant and response of joints from `snakesim run identify`.",
        add=_add_identify_arguments,
        run=_run_identify,
        details="Exit code 0: every joint was identified. 1: one was not, or does not move as it should. 2: wrong "
        "input.",
        examples=(
            "robot identify runs/identify",
            "robot identify runs/identify --write snake.toml",
        ),
    ),
)
