"""The drives of a robot, emulated, as a process on a CAN bus."""

import argparse
import contextlib
from collections.abc import Sequence
from functools import partial

import msgspec

from snakesim_can_backend.bus.adapter import check_channels, is_emulated, open_wire
from snakesim_can_backend.bus.bus import wait
from snakesim_can_backend.bus.load import MAX_LOAD
from snakesim_can_backend.can_drives.backend import CanDriveBackend
from snakesim_drivers.emulation.emulated_body import serve_until_stopped
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import die_with_parent
from snakesim_hal.base.terminal import exit_code, say
from snakesim_hal.model.scenario import Override, load, parse_set
from snakesim_hal.programs.preflight import backend_settings


def run(backend: type[CanDriveBackend], command: str, argv: Sequence[str] | None) -> int:
    """`snakesim COMMAND`. Exit code: 0 when stopped, 1 a fault, 2 wrong input and nothing started."""
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
    return exit_code(f"snakesim {command}", lambda: serve(backend, command, arguments))


def serve(backend: type[CanDriveBackend], command: str, arguments: argparse.Namespace) -> int:
    """Until a stop signal."""
    overrides = [Override("backend", backend.name, f"snakesim {command}"), *map(parse_set, arguments.set)]
    loaded = load(arguments.scenario, overrides)
    config, settings = loaded.config, backend_settings(loaded.config, backend, loaded.table)
    settings = msgspec.structs.replace(settings, channels=arguments.channel or settings.channels or ["vcan0"])
    if arguments.load:
        load_ = backend.load(config.rate_hz, settings, config.robot.joint_table)
        bus = f"{load_.drives} {backend.a_drive} at {config.rate_hz:g} Hz on {backend.rates(settings)}"
        share = f"{load_.share:.0%} at worst-case stuffing"
        say(f"{bus}: {share}; {MAX_LOAD:.0%} are allowed, so up to {load_.fits_hz} Hz")
        return 0
    for channel in settings.channels:
        if not is_emulated(channel):
            raise ConfigError(f"--channel {channel}: emulated drives beside real ones of the same ids are dangerous")
    check_channels(settings.channels, fd=settings.fd_rate is not None)
    config = msgspec.structs.replace(config, clock_mode="realtime")
    wires = [open_wire(channel, None, settings.bit_rate, settings.fd_rate) for channel in settings.channels]
    emulator = backend.emulator_on(config, settings, wires, DriverClock(config), arguments.pose)
    ready = f"{backend.a_drive} ready: {len(emulator.wires)} on {', '.join(settings.channels)}"
    with contextlib.closing(emulator):
        serve_until_stopped(ready, emulator, partial(wait, wires))
    return 0
