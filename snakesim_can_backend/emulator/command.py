"""`snakesim drive emulate can`: the joint modules of a robot, emulated, as a process on SocketCAN interfaces."""

import argparse
import dataclasses
import math
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from typing import NoReturn

import msgspec

from snakesim_can_backend.arguments import DEFAULT_CHANNEL, add_module_emulation_arguments
from snakesim_can_backend.bus.adapter import (
    is_emulated,
    open_wire,
    split_channel,
    validate_channels,
)
from snakesim_can_backend.bus.bus import Wire, inject_into, wait
from snakesim_can_backend.bus.load import count_joints_per_bus, format_bit_rate
from snakesim_can_backend.bus.local_wire import LOCAL
from snakesim_can_backend.emulator.bus_time import BusTraffic, traffic_by_opcode
from snakesim_can_backend.emulator.chain import ModuleChain
from snakesim_can_backend.emulator.faults import parse_fault, validate_fault
from snakesim_can_backend.emulator.reference_firmware import (
    replace_this_process,
    validate_firmware_settings,
)
from snakesim_can_backend.emulator.server import EmulatorServer
from snakesim_can_backend.protocol.definitions import FROM_HOST, ModuleState
from snakesim_can_backend.settings import CanSettings
from snakesim_drivers.emulation.emulator_control import EmulatorControl, TrueState
from snakesim_drivers.emulation.shared_physics import make_physics_model
from snakesim_drivers.motion_capture.emulated_mocap import PoseSender
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import (
    call_on_stop_signals,
    set_parent_death_signal,
    tune_garbage_collector,
)
from snakesim_hal.base.terminal import print_line, run_tool
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_hal.model.files import ConfigTable, decode_table
from snakesim_hal.model.scenario import KeyOverride, LoadedScenario, load_scenario, parse_set_option

TOOL = "snakesim drive emulate can"
NO_POSE = "none"
STATS_PERIOD_S = 1.0
MAX_PAUSE_S = 0.5  # until a stop signal is checked
LOST_FRAME_KINDS = ("receive_overflow", "queue_full")  # of bus errors
DRIVING_STATES = (ModuleState.ARMED, ModuleState.STOPPING)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the emulator as a program of its own, for a driver that starts its emulators.

    Returns:
        Exit code: 0 when stopped or done, 1 after a fault, 2 for wrong input, when nothing was started.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    add_module_emulation_arguments(parser)
    arguments = parser.parse_args(argv)
    return run_tool(TOOL, lambda: emulate_modules(arguments))


def emulate_modules(arguments: argparse.Namespace) -> int:
    """Run `snakesim drive emulate can`: check everything, open the buses, and serve the emulators until a stop signal.

    Args:
        arguments: Parsed command line.

    Returns:
        Exit code 0.
    """
    if arguments.parent is not None:
        set_parent_death_signal(arguments.parent)
    loaded = _load_configuration(arguments)
    settings = _make_settings(arguments, loaded)
    if arguments.firmware:
        _run_reference_firmware(arguments, loaded, settings)
    module_count = loaded.config.robot.chain.modules
    _validate_virtual_channels(settings.channels, on_real_bus=arguments.on_real_bus)
    count_joints_per_bus(loaded.config, settings)
    for text in settings.faults:
        parse_fault(text, module_count)
    with ExitStack() as exit_stack:
        send_pose = None
        if arguments.pose != NO_POSE:
            send_pose = exit_stack.enter_context(closing(PoseSender(arguments.pose)))
        validate_channels(settings.channels, is_emulator=True)
        wires: list[Wire] = []
        for channel in settings.channels:
            wire = open_wire(channel, FROM_HOST, settings.bit_rate)
            wires.append(exit_stack.enter_context(closing(wire)))
        physics_model = make_physics_model(loaded.config, settings, "can")
        chain = ModuleChain(
            loaded.config,
            settings,
            physics_model,
            is_stepped=arguments.stepped,
            send_pose=send_pose,
        )
        loop = EmulatorLoop(EmulatorServer(wires, chain), arguments, settings.bit_rate)
        control = EmulatorControl(arguments, loop.inject_typed, loop.read_true_state, exit_stack)
        call_on_stop_signals(loop.stop)
        tune_garbage_collector()
        print_line(f"modules ready: {module_count} on {', '.join(settings.channels)}")
        loop.run(control)
        for line in loop.list_summary_lines():
            print_line(line)
        return 0


def _run_reference_firmware(
    arguments: argparse.Namespace, loaded: LoadedScenario, settings: CanSettings
) -> NoReturn:
    """Run the reference firmware in C instead of this process. Raises ConfigError, and BackendError."""
    validate_firmware_settings(settings)
    folders = [
        name for interface, name in map(split_channel, settings.channels) if interface == LOCAL
    ]
    if len(settings.channels) != 1 or not folders:
        raise ConfigError(
            f"--firmware: the reference firmware has one bus, which is local, not {settings.channels}; add "
            "--channel local:FOLDER, such as local:/tmp/modules",
            code="bus/invalid-channel",
        )
    replace_this_process(
        loaded.config,
        settings,
        folders[0],
        duration_s=arguments.duration,
        is_stepped=arguments.stepped,
    )


def _load_configuration(arguments: argparse.Namespace) -> LoadedScenario:
    """Load the scenario for the backend `can`, whatever backend it runs on otherwise."""
    overrides = [KeyOverride("backend", "can", TOOL)]
    overrides += [parse_set_option(text) for text in arguments.set]
    if arguments.seed is not None:
        overrides.append(KeyOverride("seed", arguments.seed, f"--seed {arguments.seed}"))
    return load_scenario(arguments.scenario, overrides)


def _make_settings(arguments: argparse.Namespace, loaded: LoadedScenario) -> CanSettings:
    """Return the settings of the backend, with those that the command line replaces or adds."""
    section = loaded.config.backends.get("can", {})
    settings: CanSettings = decode_table(
        ConfigTable(section, arguments.scenario), CanSettings, "backends.can"
    )
    return msgspec.structs.replace(
        settings,
        channels=arguments.channel or settings.channels or [DEFAULT_CHANNEL],
        physics_model=arguments.physics_model or settings.physics_model,
        faults=[*settings.faults, *arguments.fault],
    )


def _validate_virtual_channels(channels: Sequence[str], *, on_real_bus: bool) -> None:
    """Raise ConfigError for a bus that may have real modules, unless that is allowed."""
    for channel in channels:
        if not is_emulated(channel) and not on_real_bus:
            raise ConfigError(
                f"--channel {channel}: this does not look like a virtual bus, and emulated modules beside real ones "
                "with the same node ids are dangerous. Use an interface called vcan..., or local:FOLDER, or add "
                "--on-real-bus",
                code="bus/not-virtual",
            )


class EmulatorLoop:
    """Serves the emulators until it is stopped, and keeps statistics."""

    def __init__(
        self, server: EmulatorServer, arguments: argparse.Namespace, bit_rate: int
    ) -> None:
        """Prepare to serve the emulators with the options of the command line.

        Args:
            server: The modules, with their end of each bus.
            arguments: Parsed command line.
            bit_rate: Bit rate of the buses in bit/s, for the load that is printed.
        """
        self._server = server
        self._chain = server.chain
        self._bit_rate = bit_rate
        self._should_run = True

        # Options.
        self._duration_s: float | None = arguments.duration
        self._should_print_stats: bool = arguments.stats

        # Statistics.
        self._start_s = time.monotonic()
        self._start_traffic = self._chain.read_traffic()
        self._max_lateness_s = 0.0  # of a wake-up

    def stop(self) -> None:
        """End after this cycle."""
        self._should_run = False

    def run(self, control: EmulatorControl) -> None:
        """Serve the buses until the loop is stopped or its duration is over.

        Args:
            control: Typed faults and a log of the modules.
        """
        deadline_s = math.inf if self._duration_s is None else self._start_s + self._duration_s
        last_printed_traffic = self._start_traffic
        last_printed_s = self._start_s
        while self._should_run:
            idle_duration_s = self._server.run_due(time.monotonic_ns())
            now_s = time.monotonic()
            if now_s >= deadline_s:
                return
            if self._should_print_stats and now_s - last_printed_s >= STATS_PERIOD_S:
                last_printed_traffic = self._print_loads(last_printed_traffic, now_s)
                last_printed_s = now_s
            control.run()
            if idle_duration_s is None:  # is_stepped: only a frame can make something due
                wait(self._server.wires, MAX_PAUSE_S)
                continue
            wait(self._server.wires, idle_duration_s)
            lateness_s = time.monotonic() - now_s - idle_duration_s
            self._max_lateness_s = max(self._max_lateness_s, lateness_s)

    def list_summary_lines(self) -> list[str]:
        """Return lines about the traffic of the buses, the timing accuracy, and injected faults."""
        duration_s = time.monotonic() - self._start_s
        lines = [
            f"{duration_s:.1f} s; latest wake-up {1e3 * self._max_lateness_s:.1f} ms after its time"
        ]
        for wire, before, after in zip(
            self._server.wires, self._start_traffic, self._chain.read_traffic(), strict=True
        ):
            lines += self._describe_traffic(wire.channel, before, after)
        if self._server.unsent:
            lines.append(f"{self._server.unsent} frames were not accepted by their interface")
        for wire in self._server.wires:
            lines += [
                f"{error.channel}: {error.detail}"
                for error in wire.errors()
                if error.kind in LOST_FRAME_KINDS
            ]
        if self._chain.skipped_us:
            lines.append(
                f"{self._chain.skipped_us / 1e3:.0f} ms skipped: this computer was too busy"
            )
        lines += [f"fault: {text}" for text in self._chain.fault_log]
        return lines

    def _describe_traffic(self, channel: str, before: BusTraffic, after: BusTraffic) -> list[str]:
        frames = sum(after.frames) - sum(before.frames)
        load = after.load_since(before)
        lines = [
            f"{channel}: {frames} frames, {load:.1%} of {format_bit_rate(self._bit_rate)}; "
            f"longest wait for the bus {after.late_us / 1e3:.1f} ms, {after.replaced} frames replaced by newer ones"
        ]
        for opcode, count, fraction in traffic_by_opcode(before, after):
            lines.append(f"  {opcode.name.lower():<18}{count:8d} frames {fraction:7.2%}")
        return lines

    def _print_loads(self, before: list[BusTraffic], now_s: float) -> list[BusTraffic]:
        """Print the load of every bus since an earlier point; return the traffic until now."""
        after = self._chain.read_traffic()
        loads: list[str] = []
        for wire, bus_before, bus_after in zip(self._server.wires, before, after, strict=True):
            loads.append(f"{wire.channel} {bus_after.load_since(bus_before):.1%}")
        print_line(f"{now_s - self._start_s:7.1f} s  load {', '.join(loads)}")
        return after

    def inject_typed(self, fault: FaultInjection, begins: bool) -> None:
        """Start or end a fault that was typed: of a module, or of a bus at the modules' end. Raises ConfigError."""
        if inject_into(self._server.wires, fault, begins=begins):
            return
        validate_fault(fault, self._chain.module_count)
        self._chain.inject(
            dataclasses.replace(fault, start_s=self._chain.now_us * 1e-6), begins=begins
        )

    def read_true_state(self) -> TrueState:
        """Return what the modules really do now."""
        enabled = [slot.module.state in DRIVING_STATES for slot in self._chain.slots if slot.drives]
        return TrueState(enabled, [float(angle) for angle in self._chain.physics_model.angle_rad])


if __name__ == "__main__":
    sys.exit(main())
