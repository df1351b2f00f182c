"""Emulated servos as a process, at the end of pseudo terminals with names, and the load table of a port.

What `snakesim drive emulate` and `snakesim drive load` do for every protocol of this package.
"""

import argparse
import contextlib
import select
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from snakesim_drivers.emulation.drive_emulator import serve_until_stopped
from snakesim_drivers.emulation.emulator_control import EmulatorControl
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import set_parent_death_signal
from snakesim_hal.base.terminal import print_json, print_line
from snakesim_hal.model.scenario import KeyOverride, load_scenario, parse_set_option
from snakesim_hal.programs.preflight import apply_backend_modes, decode_backend_settings
from snakesim_serial_backend.port_load import PortLoad
from snakesim_serial_backend.servo_backend import ServoBackend
from snakesim_serial_backend.wire import PseudoTerminal

TABLE_SERVOS = (1, 4, 8, 13, 18, 24)  # numbers of servos on a port in the load table


def emulate_servos(arguments: argparse.Namespace, backend: type[ServoBackend[Any]]) -> int:
    """Run `snakesim drive emulate` for a driver type: emulate its servos until a stop signal arrives.

    Args:
        arguments: Parsed command line.
        backend: Class of the driver type.

    Returns:
        Exit code 0.

    Raises:
        SnakesimError: The configuration is invalid, or a name for a port is not possible.
    """
    if arguments.parent is not None:
        set_parent_death_signal(arguments.parent)
    overrides = [
        KeyOverride("backend", backend.name, f"drive emulate {backend.name}"),
        *map(parse_set_option, arguments.set),
    ]
    loaded = load_scenario(arguments.scenario, overrides)
    config = apply_backend_modes(
        msgspec.structs.replace(loaded.config, clock_mode="realtime"), backend
    )
    link_paths = [Path(channel) for channel in arguments.channel or ["servos"]]
    settings = decode_backend_settings(config, backend, loaded.table)
    settings = msgspec.structs.replace(settings, ports=[str(link) for link in link_paths])
    with contextlib.ExitStack() as exit_stack:
        ptys = exit_stack.enter_context(create_named_ptys(link_paths))
        emulator = backend.make_robot_emulator(
            config, settings, ptys, DriverClock(config), arguments.pose
        )
        ends = ", ".join(f"{link} ({pty.path})" for link, pty in zip(link_paths, ptys, strict=True))
        ready = f"servos ready: {len(config.robot.joint_table)} on {ends}"
        control = EmulatorControl(
            arguments, emulator.inject_typed, emulator.read_true_state, exit_stack
        )
        serve_until_stopped(ready, emulator, partial(select.select, ptys, [], []), control.run)
    return 0


def print_port_load(arguments: argparse.Namespace, load: PortLoad) -> int:
    """Run `snakesim drive load` for a protocol: print bytes, duration and rate of a cycle for every baud rate.

    Args:
        arguments: Parsed command line.
        load: Load of a port by the protocol.

    Returns:
        Exit code 0.
    """
    if arguments.json:
        loads = [
            {
                "servos": servos,
                "baud": baud,
                "bytes": load.count_cycle_bytes(servos),
                "cycle_s": load.compute_cycle_duration_s(servos, baud),
                "max_rate_hz": load.compute_max_rate_hz(servos, baud),
            }
            for servos in TABLE_SERVOS
            for baud in load.rates
        ]
        print_json({"loads": loads})
        return 0
    for line in format_load_table(load):
        print_line(line)
    return 0


def format_load_table(load: PortLoad) -> Iterator[str]:
    """Yield the lines of the load table."""
    yield "servos   bytes" + "".join(f"{_format_baud(baud):>19}" for baud in load.rates)
    for servos in TABLE_SERVOS:
        cells = [
            f"{1e3 * load.compute_cycle_duration_s(servos, baud):.1f} ms, {load.compute_max_rate_hz(servos, baud)} Hz"
            for baud in load.rates
        ]
        yield f"{servos:6}{load.count_cycle_bytes(servos):8}" + "".join(
            f"{cell:>19}" for cell in cells
        )
    yield load.note


def _format_baud(baud: int) -> str:
    if baud >= 1_000_000:
        return f"{baud / 1e6:g} Mbit/s"
    return f"{baud} bit/s"


@contextlib.contextmanager
def create_named_ptys(link_paths: Sequence[Path]) -> Iterator[list[PseudoTerminal]]:
    """Create pseudo terminals and symbolic links to them; close and remove them at the end of the context.

    Args:
        link_paths: Path of the symbolic link of each pseudo terminal.

    Yields:
        The pseudo terminals, in the order of the links.

    Raises:
        ConfigError: A link cannot be created.
    """
    ptys = [PseudoTerminal() for _ in link_paths]
    created_links: list[Path] = []
    try:
        for link, pty in zip(link_paths, ptys, strict=True):
            _make_link(link, pty.path)
            created_links.append(link)
        yield ptys
    finally:
        for link in created_links:
            link.unlink(missing_ok=True)
        for pty in ptys:
            pty.close()


def _make_link(link: Path, target: str) -> None:
    """Make a symbolic link. One that an earlier run has left behind is replaced. Raises ConfigError."""
    try:
        if link.is_symlink() and not link.exists():
            link.unlink()
        link.symlink_to(target)
    except OSError as error:
        raise ConfigError(
            f"--channel {link}: {error.strerror}; give another name", code="file/not-writable"
        ) from error
