"""The commands `snakesim drive` for all drives on CAN. Importable without the extra `can`."""

import argparse

from snakesim_can_backend import arguments as options
from snakesim_can_backend.emulator.faults import describe_faults
from snakesim_drivers.kit.commands import DRIVE_NOUNS, add_emulation_arguments
from snakesim_hal.programs.commands import Command, Commands


def _scan_modules(arguments: argparse.Namespace) -> int:
    from snakesim_can_backend.can_command import scan_channels

    return scan_channels(arguments)


def _emulate_modules(arguments: argparse.Namespace) -> int:
    from snakesim_can_backend.emulator.command import emulate_modules

    return emulate_modules(arguments)


def _load_modules(arguments: argparse.Namespace) -> int:
    from snakesim_can_backend.can_command import print_module_load

    return print_module_load(arguments)


def _replay_modules(arguments: argparse.Namespace) -> int:
    from snakesim_can_backend.can_command import replay_log

    return replay_log(arguments)


def _write_dbc(arguments: argparse.Namespace) -> int:
    from snakesim_can_backend.can_command import write_dbc

    return write_dbc(arguments)


def _emulate_odrive(arguments: argparse.Namespace) -> int:
    from snakesim_can_backend.can_drives.command import emulate_drives
    from snakesim_can_backend.odrive.backend import OdriveBackend

    return emulate_drives(OdriveBackend, arguments)


def _load_odrive(arguments: argparse.Namespace) -> int:
    from snakesim_can_backend.can_drives.command import print_drive_load
    from snakesim_can_backend.odrive.backend import OdriveBackend

    return print_drive_load(OdriveBackend, arguments)


def _emulate_moteus(arguments: argparse.Namespace) -> int:
    from snakesim_can_backend.can_drives.command import emulate_drives
    from snakesim_can_backend.moteus.backend import MoteusBackend

    return emulate_drives(MoteusBackend, arguments)


def _load_moteus(arguments: argparse.Namespace) -> int:
    from snakesim_can_backend.can_drives.command import print_drive_load
    from snakesim_can_backend.moteus.backend import MoteusBackend

    return print_drive_load(MoteusBackend, arguments)


def _scan_cia402(arguments: argparse.Namespace) -> int:
    from snakesim_can_backend.cia402.scan import scan_channels

    return scan_channels(arguments)


def _emulate_cia402(arguments: argparse.Namespace) -> int:
    from snakesim_can_backend.can_drives.command import emulate_drives
    from snakesim_can_backend.cia402.backend import Cia402Backend

    return emulate_drives(Cia402Backend, arguments)


def _load_cia402(arguments: argparse.Namespace) -> int:
    from snakesim_can_backend.can_drives.command import print_drive_load
    from snakesim_can_backend.cia402.backend import Cia402Backend

    return print_drive_load(Cia402Backend, arguments)


def _add_emulation_arguments(parser: argparse.ArgumentParser) -> None:
    add_emulation_arguments(
        parser,
        "interface, INTERFACE:CHANNEL of python-can, or local:FOLDER (default: "
        f"{options.DEFAULT_CHANNEL})",
    )


COMMANDS: Commands = (
    *DRIVE_NOUNS,
    Command(
        name="drive scan can",
        help="List every joint module that answers. Sends only identify, and nothing where others use the bus.",
        add=options.add_scan_arguments,
        run=_scan_modules,
        details="Exit code: 0 a module answers, 1 none does, 2 wrong input.",
        examples=("drive scan can can0", "drive scan can can0 can1 --duration 3 --json"),
    ),
    Command(
        name="drive emulate can",
        help="Emulate the joint modules of a robot, as a process on SocketCAN interfaces.",
        add=options.add_module_emulation_arguments,
        run=_emulate_modules,
        details=f"faults:\n{describe_faults()}",
        examples=(
            "drive emulate can triplet --channel vcan0",
            "drive emulate can triplet --channel vcan0 --channel vcan1 --fault mute:joint_3@5-6",
        ),
    ),
    Command(
        name="drive load can",
        help="Print the worst-case load of the buses of a scenario with joint modules.",
        add=options.add_module_load_arguments,
        run=_load_modules,
        details="Exit code: 0 it fits, 1 it does not, 2 wrong input.",
        examples=(
            "drive load can triplet",
            "drive load can triplet --joints 13 30 --hz 50 100 200",
        ),
    ),
    Command(
        name="drive replay can",
        help="Read a log of a bus as the driver does, and compare its joint states with the run's record.",
        add=options.add_replay_arguments,
        run=_replay_modules,
        details="Exit code: 0 all joint states are the same to the bit, 1 otherwise, 2 wrong input.",
        examples=(
            "drive replay can runs/demo runs/demo/bus.log",
            "drive replay can runs/bench bench.blf",
        ),
    ),
    Command(
        name="drive dbc",
        help="Write the DBC file with every message of every joint module.",
        add=options.add_dbc_arguments,
        run=_write_dbc,
        examples=("drive dbc", "drive dbc --out modules.dbc"),
    ),
    Command(
        name="drive emulate odrive",
        help="Emulate the ODrive axes of a robot, as a process on CAN buses.",
        add=_add_emulation_arguments,
        run=_emulate_odrive,
        examples=(
            "drive emulate odrive triplet",
            "drive emulate odrive triplet --channel vcan0 --channel vcan1",
        ),
    ),
    Command(
        name="drive load odrive",
        help="Print the load of a bus with the ODrive axes of a scenario.",
        add=options.add_load_arguments,
        run=_load_odrive,
        examples=("drive load odrive triplet", "drive load odrive triplet --set rate_hz=50 --json"),
    ),
    Command(
        name="drive emulate moteus",
        help="Emulate the moteus controllers of a robot, as a process on CAN FD buses.",
        add=_add_emulation_arguments,
        run=_emulate_moteus,
        examples=(
            "drive emulate moteus triplet",
            "drive emulate moteus triplet --channel vcan0 --channel vcan1",
        ),
    ),
    Command(
        name="drive load moteus",
        help="Print the load of a bus with the moteus controllers of a scenario.",
        add=options.add_load_arguments,
        run=_load_moteus,
        examples=("drive load moteus triplet", "drive load moteus triplet --set rate_hz=50 --json"),
    ),
    Command(
        name="drive scan cia402",
        help="List every CANopen node that answers; only reads objects, and enables nothing.",
        add=options.add_canopen_scan_arguments,
        run=_scan_cia402,
        details="Exit code: 0 a node answers, 1 none does, 2 wrong input.",
        examples=("drive scan cia402 can0", "drive scan cia402 can0 --bit-rate 500000 --json"),
    ),
    Command(
        name="drive emulate cia402",
        help="Emulate the CiA 402 drives of a robot, as a process on CAN buses.",
        add=_add_emulation_arguments,
        run=_emulate_cia402,
        examples=(
            "drive emulate cia402 triplet",
            "drive emulate cia402 triplet --set 'backend.eds=[\"drive.eds\"]'",
        ),
    ),
    Command(
        name="drive load cia402",
        help="Print the load of a bus with the CiA 402 drives of a scenario.",
        add=options.add_load_arguments,
        run=_load_cia402,
        examples=("drive load cia402 triplet", "drive load cia402 triplet --set rate_hz=50 --json"),
    ),
)
