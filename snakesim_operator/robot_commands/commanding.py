"""The commands to a running robot: `snakesim robot`, `estop`, `teleop`, `param`, `sim` and `fault`."""

import argparse
import contextlib
import os
from pathlib import Path

from snakesim_hal.programs.arguments import (
    add_duration_argument,
    add_json_argument,
    add_network_arguments,
    add_unchecked_argument,
)
from snakesim_hal.programs.commands import Command, CommandGroup, Commands
from snakesim_operator.base.robot_selection import select_robots
from snakesim_operator.robot_commands.simulator_commands import SIMULATOR_COMMANDS

ESTOP_NICENESS = -10  # niceness of an emergency stop


def _add_arm(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "robot", metavar="ROBOT", help="name of the robot, as printed by `snakesim status`"
    )
    parser.add_argument("backend", metavar="BACKEND", help="its backend: sim, can, ...")
    add_unchecked_argument(parser)
    parser.add_argument(
        "--wait",
        type=float,
        default=0.0,
        metavar="SECONDS",
        help="how long to try again while no robot answers, or while it is not ready (default: 0)",
    )
    add_network_arguments(parser)


def _add_teleop(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--joystick",
        nargs="?",
        type=Path,
        const=Path(),
        metavar="DEVICE",
        help="such as /dev/input/event5 (default: the first)",
    )
    parser.add_argument(
        "--max-speed",
        type=float,
        default=0.3,
        metavar="M/S",
        help="speed at full deflection (default: 0.3)",
    )
    add_network_arguments(parser)


def _add_param_list(parser: argparse.ArgumentParser) -> None:
    add_network_arguments(parser)
    add_json_argument(parser)


def _add_param_get(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", help="such as control.speed_kp_s")
    add_network_arguments(parser)
    add_json_argument(parser)


def _add_param_set(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "values", nargs="+", metavar="NAME=VALUE", help="such as control.speed_kp_s=0.3"
    )
    add_network_arguments(parser)


def _add_fault_list(parser: argparse.ArgumentParser) -> None:
    add_json_argument(parser)


def _add_fault_inject(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "kind", metavar="KIND", help="such as mute (`snakesim fault list` explains all of them)"
    )
    parser.add_argument(
        "target", metavar="TARGET", help="such as joint_3, bus_1, control, actuator/joints"
    )
    add_duration_argument(parser, "seconds of robot time until it ends (default: until --end)")
    parser.add_argument("--amount", type=float, metavar="X", help="amount, for kinds that have one")
    parser.add_argument("--end", action="store_true", help="end it")
    add_network_arguments(parser)


def _arm_robot(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.command import arm_robot

    return arm_robot(
        arguments.robot,
        arguments.backend,
        select_robots(arguments),
        unchecked=arguments.unchecked,
        wait_s=arguments.wait,
    )


def _disarm_robot(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.command import disarm_robot

    return disarm_robot(select_robots(arguments))


def _reset_robot(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.command import reset_robot

    return reset_robot(select_robots(arguments))


def _stop_robots(arguments: argparse.Namespace) -> int:
    before = os.getpriority(os.PRIO_PROCESS, 0)
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, min(before, ESTOP_NICENESS))
    from snakesim_operator.robot_commands.stop import stop_robots

    try:
        return stop_robots(select_robots(arguments))
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, before)  # a program may call the command, and go on


def _teleoperate_robot(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.teleop.command import teleoperate_robot

    return teleoperate_robot(select_robots(arguments), arguments.max_speed, arguments.joystick)


def _list_faults(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.fault import list_faults

    return list_faults(as_json=arguments.json)


def _inject_fault(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.fault import FaultOrder, inject_fault

    order = FaultOrder(
        arguments.kind, arguments.target, arguments.duration, arguments.amount, arguments.end
    )
    return inject_fault(order, select_robots(arguments))


def _print_parameters(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.parameters import print_parameters

    return print_parameters(select_robots(arguments), as_json=arguments.json)


def _print_parameter(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.parameters import print_parameter

    return print_parameter(arguments.name, select_robots(arguments), as_json=arguments.json)


def _set_parameters(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.parameters import set_parameters

    return set_parameters(arguments.values, select_robots(arguments))


COMMANDS: Commands = (
    Command(
        name="teleop",
        heading="daily work",
        help="Drive a robot by keys or with a joystick. Letting go stops it.",
        add=_add_teleop,
        run=_teleoperate_robot,
        examples=("teleop", "teleop --joystick --max-speed 0.2"),
    ),
    Command(
        name="estop",
        heading="daily work",
        help="Stop a robot now, or all on the network without --namespace.",
        add=add_network_arguments,
        run=_stop_robots,
        details="The stop stays latched, also over a restart of the host, until `snakesim robot reset`.",
        examples=("estop", "estop --namespace planar13"),
    ),
    CommandGroup(
        name="robot",
        heading="robot",
        help="Arm, disarm and reset a robot. Calibrate and check its joints. Convert robot files.",
    ),
    Command(
        name="robot arm",
        help="Allow a robot to move. Names robot and backend, to avoid mix-ups.",
        add=_add_arm,
        run=_arm_robot,
        details=(
            "`--wait` is for scripts. A refusal that does not pass by itself, such as a fault or other settings, ends "
            "the wait at once. Exit code: 0 armed, 1 refused or not ready in time, 2 wrong input."
        ),
        examples=(
            "robot arm planar13 sim",
            "robot arm planar13 can --namespace lab/planar13 --wait 30",
        ),
    ),
    Command(
        name="robot disarm",
        help="Make a robot's joints passive.",
        add=add_network_arguments,
        run=_disarm_robot,
        examples=("robot disarm", "robot disarm --namespace planar13"),
    ),
    Command(
        name="robot reset",
        help="Reset a fault or an emergency stop. The robot is disarmed then.",
        add=add_network_arguments,
        run=_reset_robot,
        examples=("robot reset", "robot reset --namespace planar13"),
    ),
    CommandGroup(
        name="param",
        heading="robot",
        help="List, get and set parameters of the running controller.",
    ),
    Command(
        name="param list",
        help="List all parameters of the controller: value, unit, range and description.",
        add=_add_param_list,
        run=_print_parameters,
        examples=("param list", "param list --namespace planar13 --json"),
    ),
    Command(
        name="param get",
        help="Print the value of one parameter.",
        add=_add_param_get,
        run=_print_parameter,
        examples=("param get control.speed_kp_s", "param get control.speed_kp_s --json"),
    ),
    Command(
        name="param set",
        help="Change parameters, all or none. The controller continues with them, and they are recorded.",
        add=_add_param_set,
        run=_set_parameters,
        examples=(
            "param set control.speed_kp_s=0.3",
            "param set control.speed_kp_s=0.3 --namespace planar13",
        ),
    ),
    CommandGroup(name="fault", heading="robot", help="Inject faults into a run that allows it."),
    Command(
        name="fault inject",
        help="Inject a fault into a run that allows it, or end it.",
        add=_add_fault_inject,
        run=_inject_fault,
        examples=("fault inject mute joint_3 --duration 2", "fault inject mute joint_3 --end"),
    ),
    Command(
        name="fault list",
        help="Explain every kind of fault, and the targets that it has.",
        add=_add_fault_list,
        run=_list_faults,
        examples=("fault list", "fault list --json"),
    ),
    *SIMULATOR_COMMANDS,
)
