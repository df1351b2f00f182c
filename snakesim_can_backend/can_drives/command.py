"""What `snakesim drive emulate` and `snakesim drive load` do for drives on a CAN bus."""

import argparse
import contextlib
from functools import partial
from typing import Any

import msgspec

from snakesim_can_backend.arguments import DEFAULT_CHANNEL
from snakesim_can_backend.bus.adapter import is_emulated, open_wire, validate_channels
from snakesim_can_backend.bus.bus import wait
from snakesim_can_backend.bus.load import MAX_LOAD
from snakesim_can_backend.can_drives.backend import CanDriveBackend
from snakesim_drivers.emulation.drive_emulator import serve_until_stopped
from snakesim_drivers.emulation.emulator_control import EmulatorControl
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import set_parent_death_signal
from snakesim_hal.base.terminal import print_json, print_line
from snakesim_hal.model.scenario import KeyOverride, RunConfig, load_scenario, parse_set_option
from snakesim_hal.programs.preflight import decode_backend_settings


def emulate_drives(backend: type[CanDriveBackend], arguments: argparse.Namespace) -> int:
    """Run `snakesim drive emulate`: emulate the drives of a driver type until a stop signal arrives.

    Args:
        backend: Class of the driver type.
        arguments: Parsed command line.

    Returns:
        Exit code 0.

    Raises:
        SnakesimError: The configuration is invalid, or a channel is not virtual or cannot be opened.
    """
    if arguments.parent is not None:
        set_parent_death_signal(arguments.parent)
    config, settings = _load_settings(backend, "drive emulate", arguments)
    for channel in settings.channels:
        if not is_emulated(channel):
            raise ConfigError(
                f"--channel {channel}: emulated drives beside real ones of the same ids are dangerous",
                code="bus/not-virtual",
            )
    validate_channels(settings.channels, needs_fd=settings.fd_rate is not None, is_emulator=True)
    config = msgspec.structs.replace(config, clock_mode="realtime")
    wires = [
        open_wire(channel, None, settings.bit_rate, settings.fd_rate)
        for channel in settings.channels
    ]
    emulator = backend.make_emulator(config, settings, wires, DriverClock(config), arguments.pose)
    ready_text = (
        f"{backend.plural_noun} ready: {len(emulator.wires)} on {', '.join(settings.channels)}"
    )
    with contextlib.ExitStack() as exit_stack:
        exit_stack.enter_context(contextlib.closing(emulator))
        control = EmulatorControl(
            arguments, emulator.inject_typed, emulator.read_true_state, exit_stack
        )
        serve_until_stopped(ready_text, emulator, partial(wait, wires), control.run)
    return 0


def print_drive_load(backend: type[CanDriveBackend], arguments: argparse.Namespace) -> int:
    """Run `snakesim drive load`: print the bus load of a driver type, and the highest control rate that fits.

    Args:
        backend: Class of the driver type.
        arguments: Parsed command line.

    Returns:
        Exit code 0.

    Raises:
        SnakesimError: The configuration is invalid.
    """
    config, settings = _load_settings(backend, "drive load", arguments)
    bus_load = backend.compute_load(config.rate_hz, settings, config.robot.joint_table)
    if arguments.json:
        print_json(
            {
                "rate_hz": config.rate_hz,
                "drives": bus_load.drive_count,
                "load": bus_load.fraction,
                "max_load": MAX_LOAD,
                "max_rate_hz": bus_load.max_rate_hz,
            }
        )
        return 0
    rates = backend.describe_bit_rates(settings)
    print_line(
        f"{bus_load.drive_count} {backend.plural_noun} at {config.rate_hz:g} Hz on {rates}: "
        f"{bus_load.fraction:.0%} at worst-case stuffing; {MAX_LOAD:.0%} are allowed, so up to "
        f"{bus_load.max_rate_hz} Hz"
    )
    return 0


def _load_settings(
    backend: type[CanDriveBackend], command: str, arguments: argparse.Namespace
) -> tuple[RunConfig, Any]:
    """Load the scenario of a command line for a backend.

    The channels are those of the command line; else those of the scenario; else DEFAULT_CHANNEL.

    Args:
        backend: Class of the driver type.
        command: Name of the command, used as the origin of settings in error messages.
        arguments: Parsed command line.

    Returns:
        The configuration of the run, and the settings of the backend: an instance of its class `Settings`.
    """
    overrides = [
        KeyOverride("backend", backend.name, flag=f"{command} {backend.name}"),
        *map(parse_set_option, arguments.set),
    ]
    loaded = load_scenario(arguments.scenario, overrides)
    settings = decode_backend_settings(loaded.config, backend, loaded.table)
    channels = arguments.channel or settings.channels or [DEFAULT_CHANNEL]
    return loaded.config, msgspec.structs.replace(settings, channels=channels)
