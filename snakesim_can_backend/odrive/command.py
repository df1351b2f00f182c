"""`snakesim odrives`: the ODrive axes of a robot, emulated, as a process on a CAN bus."""

import argparse
import sys
from collections.abc import Sequence

import msgspec

from snakesim_can_backend.bus.adapter import is_emulated, open_wire
from snakesim_can_backend.bus.bus import Wire, wait
from snakesim_can_backend.bus.load import MAX_LOAD
from snakesim_can_backend.odrive.backend import NAME, OdriveSettings, load_of, twin_on
from snakesim_hal.drivers.drive_backend import Clock
from snakesim_hal.errors import ConfigError, SnakesimError
from snakesim_hal.model.files import Table, decode
from snakesim_hal.model.scenario import Override, load, parse_set
from snakesim_hal.process import die_with_parent, on_stop_signal, tune_garbage_collector
from snakesim_hal.terminal import report_error, say

POLL_S = 0.001


def main(argv: Sequence[str] | None = None) -> int:
    """Exit code: 0 when stopped, 1 a fault, 2 wrong input and nothing started."""
    arguments = parser().parse_args(argv)
    if arguments.parent is not None:
        die_with_parent(arguments.parent)
    try:
        serve(arguments)
    except SnakesimError as error:
        report_error(error, "snakesim odrives")
        return 2 if isinstance(error, ConfigError) else 1
    return 0


def parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = argparse.ArgumentParser(prog="snakesim odrives", description=__doc__)
    add = parser.add_argument
    add("scenario", help="name of a shipped scenario, or path of a scenario file")
    add("--channel", action="append", metavar="vcan0", help="interface, or INTERFACE:CHANNEL; repeat (default: vcan0)")
    add("--load", action="store_true", help="print the bus load of the configuration, and end")
    add("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="change any value; may be repeated")
    add("--pose", metavar="HOST:PORT", help="where to send poses of motion capture (default: nowhere)")
    add("--parent", type=int, help="process id of the parent; this process dies with it")
    return parser


def serve(arguments: argparse.Namespace) -> None:
    """Until a stop signal."""
    overrides = [Override("backend", NAME, "snakesim odrives"), *map(parse_set, arguments.set)]
    config = load(arguments.scenario, overrides).config
    settings: OdriveSettings = decode(
        Table(config.backends.get(NAME, {}), arguments.scenario), OdriveSettings, f"backends.{NAME}"
    )
    settings = msgspec.structs.replace(settings, channels=arguments.channel or settings.channels or ["vcan0"])
    if arguments.load:
        share, fits_hz, fullest = load_of(config, settings)
        bus = f"{fullest} axes at {config.rate_hz:g} Hz on {settings.bit_rate / 1e6:g} Mbit/s"
        say(f"{bus}: {share:.0%} at worst-case stuffing; {MAX_LOAD:.0%} are allowed, so up to {fits_hz} Hz")
        return
    for channel in settings.channels:
        if not is_emulated(channel):
            raise ConfigError(f"--channel {channel}: emulated axes beside real ones of the same ids are dangerous")
    config = msgspec.structs.replace(config, pace="realtime")
    wires: list[Wire] = [open_wire(channel, bit_rate=settings.bit_rate) for channel in settings.channels]
    twin = twin_on(config, settings, wires, Clock(config), arguments.pose)
    running = [True]
    on_stop_signal(lambda: running.clear())
    tune_garbage_collector()
    say(f"axes ready: {len(twin.axes)} on {', '.join(settings.channels)}")
    try:
        while running:
            twin()
            wait(wires, POLL_S)
    finally:
        twin.close()


if __name__ == "__main__":
    sys.exit(main())
