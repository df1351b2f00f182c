"""Arguments of the commands to a running robot: `snakesim arm`, `disarm`, `clear`, `estop`, `param`, ..."""

import argparse
import contextlib
import os
from pathlib import Path
from typing import Any

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.programs.arguments import add_network, add_unchecked
from snakesim_operator.base.robot_selection import RobotSelection, select_robots
from snakesim_operator.robot_commands.simulator_order import add_command as add_sim
from snakesim_operator.robot_commands.simulator_order import order_of

URGENT = -10  # niceness of an emergency stop


def add_commands(commands: Any) -> None:
    """Add them to the parser of `snakesim`."""
    arm = commands.add_parser("arm", help="allow a robot to move; names robot and backend, to avoid mix-ups")
    arm.add_argument("robot", metavar="ROBOT", help="name of the robot, as printed by `snakesim status`")
    arm.add_argument("backend", metavar="BACKEND", help="its backend: sim, can, ...")
    add_unchecked(arm)
    add_network(arm)
    arm.set_defaults(act=_arm)
    for name, act, about in (
        ("disarm", _disarm, "make a robot's joints passive"),
        ("clear", _clear, "clear a fault or an emergency stop; the robot is disarmed then"),
        ("estop", _estop, "stop a robot now, or all on the network without --namespace"),
    ):
        command = commands.add_parser(name, help=about)
        add_network(command)
        command.set_defaults(act=act)

    teleop = commands.add_parser("teleop", help="drive a robot by keys or with a joystick; letting go stops it")
    teleop.add_argument(
        "--joystick",
        nargs="?",
        type=Path,
        const=Path(),
        metavar="DEVICE",
        help="such as /dev/input/event5; or the first",
    )
    teleop.add_argument("--fastest", type=float, default=0.3, metavar="M/S", help="highest speed (0.3)")
    add_network(teleop)
    teleop.set_defaults(act=_teleop)

    _add_param(commands)

    sim = add_sim(commands)
    add_network(sim)
    sim.set_defaults(act=_sim)

    fault = commands.add_parser(
        "fault", help="inject a fault into a run that allows it", epilog="`snakesim fault list` explains every kind."
    )
    fault.add_argument("kind", metavar="KIND", help="such as mute; `list` prints all of them")
    fault.add_argument("target", nargs="?", metavar="TARGET", help="such as joint_3, bus_1, control, actuator/joints")
    fault.add_argument("--for", dest="for_s", type=float, metavar="S", help="seconds of robot time until it ends")
    fault.add_argument("--amount", type=float, metavar="X", help="amount, for kinds that have one")
    fault.add_argument("--end", action="store_true", help="end it")
    add_network(fault)
    fault.set_defaults(act=_fault)


def _add_param(commands: Any) -> None:
    param = commands.add_parser("param", help="list, get and set parameters of the running controller")
    verbs = param.add_subparsers(dest="verb", required=True, metavar="VERB")
    for verb, act, about in (
        ("list", _param_list, "all of them: value, unit, range, what each is"),
        ("get", _param_get, "the value of one"),
        ("set", _param_set, "change them, all or none; the controller goes on with them, and they are recorded"),
    ):
        command = verbs.add_parser(verb, help=about)
        command.add_argument("robot", metavar="ROBOT", help="its namespace, as printed by `snakesim status`")
        if verb == "get":
            command.add_argument("name", metavar="NAME", help="such as control.speed_kp_s")
        if verb == "set":
            command.add_argument("values", nargs="+", metavar="NAME=VALUE", help="such as control.speed_kp_s=0.3")
        add_network(command)
        command.set_defaults(act=act)


def _arm(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.command import arm

    return arm(arguments.robot, arguments.backend, select_robots(arguments), unchecked=arguments.unchecked)


def _disarm(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.command import disarm

    return disarm(select_robots(arguments))


def _clear(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.command import clear

    return clear(select_robots(arguments))


def _estop(arguments: argparse.Namespace) -> int:
    before = os.getpriority(os.PRIO_PROCESS, 0)
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, min(before, URGENT))
    from snakesim_operator.robot_commands.stop import estop

    try:
        return estop(select_robots(arguments))
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, before)  # a program may call the command, and go on


def _teleop(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.teleop.command import teleop

    return teleop(select_robots(arguments), arguments.fastest, arguments.joystick)


def _sim(arguments: argparse.Namespace) -> int:
    order = order_of(arguments)
    from snakesim_operator.robot_commands.command import simulator

    return simulator(order, select_robots(arguments))


def _fault(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.fault import FaultOrder, fault

    order = FaultOrder(arguments.kind, arguments.target, arguments.for_s, arguments.amount, arguments.end)
    return fault(order, select_robots(arguments))


def _param_list(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.parameters import list_parameters

    return list_parameters(_robot_of(arguments))


def _param_get(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.parameters import get_parameter

    return get_parameter(arguments.name, _robot_of(arguments))


def _param_set(arguments: argparse.Namespace) -> int:
    from snakesim_operator.robot_commands.parameters import set_parameters

    return set_parameters(arguments.values, _robot_of(arguments))


def _robot_of(arguments: argparse.Namespace) -> RobotSelection:
    """The robot that is named, by its namespace."""
    if arguments.namespace not in (None, arguments.robot):
        raise ConfigError(
            f"{arguments.robot} and --namespace {arguments.namespace}: name one robot; leave one out",
            code="command/conflicting-options",
        )
    arguments.namespace = arguments.robot
    return select_robots(arguments)
