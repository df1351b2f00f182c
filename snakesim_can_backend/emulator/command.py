"""`snakesim modules`: the joint modules of a robot, emulated, as a process on SocketCAN interfaces."""

import argparse
import select
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, closing

import msgspec

from snakesim_can_backend.bus.adapter import check_channels, is_emulated, open_wire
from snakesim_can_backend.bus.bus import Wire, wait
from snakesim_can_backend.bus.load import format_bit_rate, joints_per_bus
from snakesim_can_backend.emulator.bus_time import Traffic, traffic_by_opcode
from snakesim_can_backend.emulator.chain import ModuleChain
from snakesim_can_backend.emulator.faults import describe_faults, parse_fault, parse_typed_fault
from snakesim_can_backend.emulator.server import EmulatorServer
from snakesim_can_backend.protocol.definitions import FROM_HOST
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.emulation.emulated_body import make_physics_model
from snakesim_drivers.motion_capture.emulated_mocap import PoseSender
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import die_with_parent, on_stop_signal, tune_garbage_collector
from snakesim_hal.base.terminal import exit_code, say
from snakesim_hal.model.files import Table, decode
from snakesim_hal.model.scenario import Loaded, Override, load, parse_set

DEFAULT_CHANNEL = "vcan0"
DEFAULT_POSE, NO_POSE = "127.0.0.1:7450", "none"
STATS_EVERY_S = 1.0
LONGEST_PAUSE_S = 0.5  # until a stop signal is checked


def main(argv: Sequence[str] | None = None) -> int:
    """Exit code: 0 when stopped or done, 1 a fault, 2 wrong input and nothing started."""
    arguments = parser().parse_args(argv)
    if arguments.parent is not None:
        die_with_parent(arguments.parent)
    return exit_code("snakesim modules", lambda: _serve(arguments))


def parser() -> argparse.ArgumentParser:
    """The command's arguments."""
    parser = argparse.ArgumentParser(
        prog="snakesim modules",
        description=__doc__,
        epilog=f"faults:\n{describe_faults()}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("scenario", help="name of a shipped scenario, or path of a scenario file or a run's config.json")
    add(
        "--channel",
        action="append",
        metavar="vcan0",
        help="interface, or INTERFACE:CHANNEL of python-can; repeat, tail to head",
    )
    add("--physics-model", help="body that the motors move: mujoco, inertia, or ./file.py:Class")
    add("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="change any value; may be repeated")
    add("--fault", action="append", default=[], metavar="KIND:JOINT@START[-END]", help="inject a fault, at this time")
    add("--interactive", action="store_true", help="read `KIND joint_N` and `KIND joint_N off` from the terminal")
    add("--stepped", action="store_true", help="advance time only from Sync to Sync, for a host in lockstep")
    add(
        "--pose",
        default=DEFAULT_POSE,
        metavar="HOST:PORT",
        help=f"where to send poses, or none (default: {DEFAULT_POSE})",
    )
    add("--duration", type=float, metavar="S", help="end after this many seconds")
    add("--seed", type=int, help="of the sensors' noise and the serial numbers")
    add("--stats", action="store_true", help="print the load of every bus once a second")
    add("--on-real-bus", action="store_true", help="allow interfaces that are not called vcan...")
    add("--parent", type=int, help="process id of the parent; this process dies with it")
    return parser


def _serve(arguments: argparse.Namespace) -> int:
    loaded = _configuration(arguments)
    settings = _settings(arguments, loaded)
    _check_names(settings.channels, on_real_bus=arguments.on_real_bus)
    joints_per_bus(loaded.config, settings)
    for text in settings.faults:
        parse_fault(text, loaded.config.robot.chain.modules)
    with ExitStack() as opened:
        send_pose = None
        if arguments.pose != NO_POSE:
            send_pose = opened.enter_context(closing(PoseSender(arguments.pose)))
        check_channels(settings.channels)
        wires: list[Wire] = []
        for channel in settings.channels:
            wires.append(opened.enter_context(closing(open_wire(channel, FROM_HOST, settings.bit_rate))))
        physics_model = make_physics_model(loaded.config, settings, "can")
        chain = ModuleChain(loaded.config, settings, physics_model, stepped=arguments.stepped, send_pose=send_pose)
        loop = Loop(EmulatorServer(wires, chain), arguments, settings.bit_rate)
        on_stop_signal(loop.stop)
        tune_garbage_collector()
        count = loaded.config.robot.chain.modules
        say(f"modules ready: {count} on {', '.join(settings.channels)}")
        loop.run()
        for line in loop.summary():
            say(line)
        return 0


def _configuration(arguments: argparse.Namespace) -> Loaded:
    overrides = [parse_set(text) for text in arguments.set]
    if arguments.seed is not None:
        overrides.append(Override("seed", arguments.seed, f"--seed {arguments.seed}"))
    # The emulators are the robot of `--backend can`, whatever the scenario runs on otherwise.
    return load(arguments.scenario, [Override("backend", "can", "snakesim modules"), *overrides])


def _settings(arguments: argparse.Namespace, loaded: Loaded) -> CanSettings:
    section = loaded.config.backends.get("can", {})
    settings: CanSettings = decode(Table(section, arguments.scenario), CanSettings, "backends.can")
    return msgspec.structs.replace(
        settings,
        channels=arguments.channel or settings.channels or [DEFAULT_CHANNEL],
        physics_model=arguments.physics_model or settings.physics_model,
        faults=[*settings.faults, *arguments.fault],
    )


def _check_names(channels: Sequence[str], *, on_real_bus: bool) -> None:
    for channel in channels:
        if not is_emulated(channel) and not on_real_bus:
            raise ConfigError(
                f"--channel {channel}: this does not look like a virtual bus, and emulated modules beside real ones "
                "with the same node ids are dangerous. Use an interface called vcan..., or add --on-real-bus"
            )


class Loop:
    """Serves until it is stopped, and keeps count."""

    def __init__(self, server: EmulatorServer, arguments: argparse.Namespace, bit_rate: int) -> None:
        self._bit_rate = bit_rate
        self._server, self._chain = server, server.chain
        self._duration_s, self._stats = arguments.duration, arguments.stats
        self._interactive = arguments.interactive
        self._running = True
        self._late_s = 0.0
        self._start = self._chain.traffic()
        self._start_s = time.monotonic()

    def stop(self) -> None:
        """End after this cycle."""
        self._running = False

    def run(self) -> None:
        """Handle, send, sleep."""
        server, wires = self._server, self._server.wires
        end_s = None if self._duration_s is None else self._start_s + self._duration_s
        shown, shown_s = self._start, self._start_s
        while self._running:
            pause_s = server.run_due(time.monotonic_ns())
            now_s = time.monotonic()
            if end_s is not None and now_s >= end_s:
                return
            if self._stats and now_s - shown_s >= STATS_EVERY_S:
                shown, shown_s = self._show(shown, now_s), now_s
            if self._interactive:
                self._read_terminal()
            asked_s = LONGEST_PAUSE_S if pause_s is None else pause_s
            wait(wires, asked_s)
            if pause_s is not None:
                self._late_s = max(self._late_s, time.monotonic() - now_s - asked_s)

    def summary(self) -> list[str]:
        """Traffic of the buses, and timing accuracy."""
        seconds = time.monotonic() - self._start_s
        lines = [f"{seconds:.1f} s; latest wake-up {1e3 * self._late_s:.1f} ms after its time"]
        for wire, before, after in zip(self._server.wires, self._start, self._chain.traffic(), strict=True):
            frames = sum(after.frames) - sum(before.frames)
            lines.append(
                f"{wire.channel}: {frames} frames, {after.load_since(before):.1%} of {format_bit_rate(self._bit_rate)}; "
                f"longest wait for the bus {after.late_us / 1e3:.1f} ms, {after.replaced} frames replaced by newer ones"
            )
            lines += [
                f"  {op.name.lower():<18}{n:8d} frames {share:7.2%}"
                for op, n, share in traffic_by_opcode(before, after)
            ]
        if self._server.unsent:
            lines.append(f"{self._server.unsent} frames were not accepted by their interface")
        if self._chain.skipped_us:
            lines.append(f"{self._chain.skipped_us / 1e3:.0f} ms skipped: this computer was too busy")
        return lines + [f"fault: {text}" for text in self._chain.fault_log]

    def _show(self, before: list[Traffic], now_s: float) -> list[Traffic]:
        after = self._chain.traffic()
        loads = [
            f"{wire.channel} {b.load_since(a):.1%}"
            for wire, a, b in zip(self._server.wires, before, after, strict=True)
        ]
        say(f"{now_s - self._start_s:7.1f} s  load {', '.join(loads)}")
        return after

    def _read_terminal(self) -> None:
        while self._interactive and select.select([sys.stdin], [], [], 0)[0]:
            line = sys.stdin.readline()
            if not line:
                self._interactive = False
            elif line.strip():
                try:
                    fault, begins = parse_typed_fault(line, self._chain.module_count, self._chain.now_us * 1e-6)
                except ConfigError as error:
                    say(str(error))
                else:
                    self._chain.inject(fault, begins=begins)


if __name__ == "__main__":
    sys.exit(main())
