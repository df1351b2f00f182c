"""Arguments of the commands for drives on CAN. They can be imported without the extra `can`."""

import argparse
from pathlib import Path

from snakesim_can_backend.protocol.definitions import LAST_NODE
from snakesim_drivers.kit.commands import (
    add_channel_argument,
    add_channels_arguments,
    add_control_arguments,
    add_pose_argument,
)
from snakesim_hal.programs.arguments import (
    add_duration_argument,
    add_json_argument,
    add_output_argument,
    add_parent_argument,
    add_scenario_name_argument,
    add_seed_argument,
    add_set_argument,
    make_number_parser,
)

DEFAULT_CHANNEL = "vcan0"
DEFAULT_POSE = "127.0.0.1:7450"
EXPANDED_DBC_FILENAME = "snakesim-expanded.dbc"
MIN_RATE_HZ = 20.0
MAX_RATE_HZ = 5000.0  # of a scenario
CHANNEL_ABOUT = "SocketCAN interface such as can0, INTERFACE:CHANNEL such as slcan:/dev/ttyACM0, or local:FOLDER"


def add_scan_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of a scan of a CAN bus."""
    add_channels_arguments(parser, CHANNEL_ABOUT)
    _add_bit_rate_argument(parser)
    add_duration_argument(
        parser,
        "seconds to listen on each bus (default: 1)",
        make_number_parser(0.001, 3600, "s"),
        1.0,
    )
    parser.add_argument(
        "--anyway", action="store_true", help="send requests also where others use the bus"
    )


def add_canopen_scan_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of a scan of a CANopen bus."""
    add_channels_arguments(parser, CHANNEL_ABOUT)
    _add_bit_rate_argument(parser)


def _add_bit_rate_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--bit-rate",
        type=make_number_parser(10_000, 1_000_000, "bit/s"),
        default=1_000_000,
        metavar="BIT/S",
        help="of an adapter (default: 1000000)",
    )


def add_module_load_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `snakesim drive load can`, which computes the bus load of joint modules."""
    add_scenario_name_argument(parser)
    add_set_argument(parser)
    parser.add_argument(
        "--joints",
        type=make_number_parser(1, LAST_NODE, "joints"),
        nargs="+",
        metavar="N",
        help="print a table: for a robot with this many joints",
    )
    parser.add_argument(
        "--hz",
        type=make_number_parser(MIN_RATE_HZ, MAX_RATE_HZ, "Hz"),
        nargs="+",
        metavar="HZ",
        help="print a table: for these control rates",
    )
    add_json_argument(parser)


def add_load_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the bus load of drives."""
    add_scenario_name_argument(parser)
    add_channel_argument(parser, f"bus of the drives (default: {DEFAULT_CHANNEL})")
    add_set_argument(parser)
    add_json_argument(parser)


def add_replay_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that read a log of the bus of joint modules."""
    parser.add_argument(
        "run",
        type=Path,
        metavar="RUN",
        help="folder of the run, with config.json and its black box",
    )
    parser.add_argument(
        "log",
        type=Path,
        metavar="LOG",
        help="log of its bus: .log (of candump, or backends.can.log of a run), .asc, .blf",
    )


def add_dbc_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that write the DBC file."""
    add_output_argument(parser, f"the DBC file (default: {EXPANDED_DBC_FILENAME})")


def add_module_emulation_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `snakesim drive emulate can`, which emulates joint modules on a bus."""
    add_scenario_name_argument(parser)
    add_channel_argument(
        parser,
        "interface, INTERFACE:CHANNEL of python-can, or local:FOLDER, tail to head (default: "
        f"{DEFAULT_CHANNEL})",
    )
    parser.add_argument(
        "--firmware",
        action="store_true",
        help="run the reference firmware in C, each module with a simulated joint of its own, on --channel "
        "local:FOLDER",
    )
    parser.add_argument(
        "--physics-model",
        metavar="NAME",
        help="body that the motors move: mujoco, inertia, or ./file.py:Class",
    )
    add_set_argument(parser)
    parser.add_argument(
        "--fault",
        action="append",
        default=[],
        metavar="FAULT",
        help="inject a fault, as KIND:JOINT@START[-END] in seconds (may be repeated)",
    )
    add_control_arguments(parser)
    parser.add_argument(
        "--stepped",
        action="store_true",
        help="advance time only from Sync to Sync, for a host in lockstep",
    )
    add_pose_argument(parser, f"or none, default: {DEFAULT_POSE}", DEFAULT_POSE)
    add_duration_argument(parser, "end after this many seconds")
    add_seed_argument(parser, "of noise and serial numbers, default: the scenario's")
    parser.add_argument(
        "--stats", action="store_true", help="print the load of every bus once a second"
    )
    parser.add_argument(
        "--on-real-bus", action="store_true", help="allow interfaces that are not called vcan..."
    )
    add_parent_argument(parser)
