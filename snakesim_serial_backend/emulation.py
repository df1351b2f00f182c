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
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import die_with_parent
from snakesim_hal.base.terminal import print_json, print_line
from snakesim_hal.model.scenario import Override, load, parse_set
from snakesim_hal.programs.preflight import backend_settings, with_backend_modes
from snakesim_serial_backend.port_load import PortLoad
from snakesim_serial_backend.servo_backend import ServoBackend
from snakesim_serial_backend.wire import Pty

TABLE_SERVOS = (1, 4, 8, 13, 18, 24)  # numbers of servos on a port in the load table


def emulate_servos(arguments: argparse.Namespace, backend: type[ServoBackend[Any]]) -> int:
    """Emulate the servos until a stop signal. Returns 0; raises SnakesimError."""
    if arguments.parent is not None:
        die_with_parent(arguments.parent)
    overrides = [Override("backend", backend.name, f"drive emulate {backend.name}"), *map(parse_set, arguments.set)]
    loaded = load(arguments.scenario, overrides)
    config = with_backend_modes(msgspec.structs.replace(loaded.config, clock_mode="realtime"), backend)
    links = [Path(channel) for channel in arguments.channel or ["servos"]]
    settings = backend_settings(config, backend, loaded.table)
    settings = msgspec.structs.replace(settings, ports=[str(link) for link in links])
    with named(links) as ptys:
        emulator = backend.make_robot_emulator(config, settings, ptys, DriverClock(config), arguments.pose)
        ends = ", ".join(f"{link} ({pty.path})" for link, pty in zip(links, ptys, strict=True))
        ready = f"servos ready: {len(config.robot.joint_table)} on {ends}"
        serve_until_stopped(ready, emulator, partial(select.select, ptys, [], []))
    return 0


def print_port_load(arguments: argparse.Namespace, load: PortLoad) -> int:
    """Print bytes, time and rate of a cycle for every baud rate. Returns 0."""
    if arguments.json:
        loads = [
            {
                "servos": servos,
                "baud": baud,
                "bytes": load.cycle_bytes(servos),
                "cycle_s": load.cycle_s(servos, baud),
                "max_rate_hz": load.fits_hz(servos, baud),
            }
            for servos in TABLE_SERVOS
            for baud in load.rates
        ]
        print_json({"loads": loads})
        return 0
    for line in table(load):
        print_line(line)
    return 0


def table(load: PortLoad) -> Iterator[str]:
    """Yield the lines of the load table."""
    yield "servos   bytes" + "".join(f"{_baud(baud):>19}" for baud in load.rates)
    for servos in TABLE_SERVOS:
        cells = [f"{1e3 * load.cycle_s(servos, baud):.1f} ms, {load.fits_hz(servos, baud)} Hz" for baud in load.rates]
        yield f"{servos:6}{load.cycle_bytes(servos):8}" + "".join(f"{cell:>19}" for cell in cells)
    yield load.note


def _baud(baud: int) -> str:
    if baud >= 1_000_000:
        return f"{baud / 1e6:g} Mbit/s"
    return f"{baud} bit/s"


@contextlib.contextmanager
def named(links: Sequence[Path]) -> Iterator[list[Pty]]:
    """Make pseudo terminals with names, which are removed at the end.

    Raises:
        ConfigError: a name is not possible.
    """
    ptys = [Pty() for _ in links]
    made: list[Path] = []
    try:
        for link, pty in zip(links, ptys, strict=True):
            _make_link(link, pty.path)
            made.append(link)
        yield ptys
    finally:
        for link in made:
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
        raise ConfigError(f"--channel {link}: {error.strerror}; give another name", code="file/not-writable") from error
