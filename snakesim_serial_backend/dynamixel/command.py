"""What `snakesim drive emulate dynamixel` and `drive load dynamixel` do: servos at the end of pseudo terminals."""

import argparse
import contextlib
import select
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import msgspec

from snakesim_drivers.emulation.drive_emulator import serve_until_stopped
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import die_with_parent
from snakesim_hal.base.terminal import print_json, print_line
from snakesim_hal.model.scenario import Override, load, parse_set
from snakesim_hal.programs.preflight import backend_settings
from snakesim_serial_backend.dynamixel.backend import DynamixelBackend, emulator_on
from snakesim_serial_backend.dynamixel.load import MAX_LOAD, cycle_bytes, cycle_s, fits_hz
from snakesim_serial_backend.dynamixel.registers import RATE
from snakesim_serial_backend.dynamixel.settings import NAME, DynamixelSettings
from snakesim_serial_backend.wire import Pty

TABLE_SERVOS = (1, 4, 8, 13, 18, 24)  # numbers of servos on a port in the load table


def emulate(arguments: argparse.Namespace) -> int:
    """Emulate the servos until a stop signal. Returns 0; raises SnakesimError."""
    if arguments.parent is not None:
        die_with_parent(arguments.parent)
    overrides = [Override("backend", NAME, "drive emulate dynamixel"), *map(parse_set, arguments.set)]
    loaded = load(arguments.scenario, overrides)
    config = msgspec.structs.replace(loaded.config, clock_mode="realtime")
    links = [Path(channel) for channel in arguments.channel or ["servos"]]
    settings: DynamixelSettings = backend_settings(config, DynamixelBackend, loaded.table)
    settings = msgspec.structs.replace(settings, ports=[str(link) for link in links])
    with named(links) as ptys:
        emulator = emulator_on(config, settings, ptys, DriverClock(config), arguments.pose)
        ends = ", ".join(f"{link} ({pty.path})" for link, pty in zip(links, ptys, strict=True))
        ready = f"servos ready: {len(emulator.servos)} on {ends}"
        serve_until_stopped(ready, emulator, partial(select.select, ptys, [], []))
    return 0


def print_load(arguments: argparse.Namespace) -> int:
    """Print bytes, time and rate of a cycle for every baud rate. Returns 0."""
    if arguments.json:
        loads = [
            {
                "servos": servos,
                "baud": baud,
                "bytes": cycle_bytes(servos),
                "cycle_s": cycle_s(servos, baud),
                "max_rate_hz": fits_hz(servos, baud),
            }
            for servos in TABLE_SERVOS
            for baud in RATE
        ]
        print_json({"loads": loads})
        return 0
    for line in table():
        print_line(line)
    return 0


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


def table() -> Iterator[str]:
    """Yield the lines of the load table."""
    rates = list(RATE)
    yield "servos   bytes" + "".join(f"{_baud(baud):>19}" for baud in rates)
    for servos in TABLE_SERVOS:
        cells = [f"{1e3 * cycle_s(servos, baud):.1f} ms, {fits_hz(servos, baud)} Hz" for baud in rates]
        yield f"{servos:6}{cycle_bytes(servos):8}" + "".join(f"{cell:>19}" for cell in cells)
    yield (
        f"A cycle on one port: fast sync read, health of one, sync write; an adapter's latency of 1 ms for each of two "
        f"questions; the fastest rate at which it takes {MAX_LOAD:.0%} of a period"
    )


def _baud(baud: int) -> str:
    if baud >= 1_000_000:
        return f"{baud / 1e6:g} Mbit/s"
    return f"{baud} bit/s"
