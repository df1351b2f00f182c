"""The drives of a robot, emulated, as a process on a CAN bus."""

import argparse
import contextlib
from collections.abc import Sequence
from functools import partial
from typing import Any

import msgspec

from snakesim_can_backend.bus.adapter import check_channels, is_emulated, open_wire
from snakesim_can_backend.bus.bus import wait
from snakesim_can_backend.bus.load import MAX_LOAD
from snakesim_can_backend.can_drives.backend import CanDriveBackend
from snakesim_drivers.emulation.drive_emulator import serve_until_stopped
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import die_with_parent
from snakesim_hal.base.terminal import print_line, run_tool
from snakesim_hal.model.scenario import Override, RunConfig, load, parse_set
from snakesim_hal.programs.preflight import backend_settings

DEFAULT_CHANNEL = "vcan0"


def run(backend: type[CanDriveBackend], command: str, argv: Sequence[str] | None) -> int:
    """Run `snakesim COMMAND`, which emulates the drives of a driver type.

    Args:
        backend: The driver type.
        command: The name of the command, for its help and messages.
        argv: The arguments; None: those of the process.

    Returns:
        The exit code: 0 when stopped, 1 for a fault, 2 if the input is wrong and nothing was started.
    """
    parser = argparse.ArgumentParser(prog=f"snakesim {command}", description=__doc__)
    add = parser.add_argument
    add("scenario", help="name of a shipped scenario, or path of a scenario file")
    add("--channel", action="append", metavar="vcan0", help="interface, or INTERFACE:CHANNEL; repeat (default: vcan0)")
    add("--load", action="store_true", help="print the bus load of the configuration, and end")
    add("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="change any value; may be repeated")
    add("--pose", metavar="HOST:PORT", help="where to send poses of motion capture (default: nowhere)")
    add("--parent", type=int, help="process id of the parent; this process dies with it")
    arguments = parser.parse_args(argv)
    if arguments.parent is not None:
        die_with_parent(arguments.parent)
    return run_tool(f"snakesim {command}", lambda: serve(backend, command, arguments))


def serve(backend: type[CanDriveBackend], command: str, arguments: argparse.Namespace) -> int:
    """Emulate the drives until a stop signal arrives, or print the bus load."""
    overrides = [Override("backend", backend.name, f"snakesim {command}"), *map(parse_set, arguments.set)]
    loaded = load(arguments.scenario, overrides)
    config = loaded.config
    settings = backend_settings(config, backend, loaded.table)
    channels = arguments.channel or settings.channels or [DEFAULT_CHANNEL]
    settings = msgspec.structs.replace(settings, channels=channels)
    if arguments.load:
        _print_load(backend, config, settings)
        return 0
    for channel in channels:
        if not is_emulated(channel):
            raise ConfigError(
                f"--channel {channel}: emulated drives beside real ones of the same ids are dangerous",
                code="bus/not-virtual",
            )
    check_channels(channels, fd=settings.fd_rate is not None)
    config = msgspec.structs.replace(config, clock_mode="realtime")
    wires = [open_wire(channel, None, settings.bit_rate, settings.fd_rate) for channel in channels]
    emulator = backend.emulator_on(config, settings, wires, DriverClock(config), arguments.pose)
    ready_text = f"{backend.plural_noun} ready: {len(emulator.wires)} on {', '.join(channels)}"
    with contextlib.closing(emulator):
        serve_until_stopped(ready_text, emulator, partial(wait, wires))
    return 0


def _print_load(backend: type[CanDriveBackend], config: RunConfig, settings: Any) -> None:
    bus_load = backend.compute_load(config.rate_hz, settings, config.robot.joint_table)
    rates = backend.describe_rates(settings)
    print_line(
        f"{bus_load.drives} {backend.plural_noun} at {config.rate_hz:g} Hz on {rates}: "
        f"{bus_load.share:.0%} at worst-case stuffing; {MAX_LOAD:.0%} are allowed, so up to {bus_load.fits_hz} Hz"
    )
