"""Emulates the drives of a robot in a separate process, which records when each drive is enabled and disabled.

Run it with `python -m verification.faults.drives_process CONFIG RECORD --pose HOST:PORT --parent PID`. It opens the
buses that the configuration names, and runs until a stop signal. RECORD gets one JSON line for each change: the time by
the monotonic clock in ns, and for each joint from tail to head whether its drive is enabled.
"""

import argparse
import contextlib
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from snakesim_can_backend.bus.adapter import open_wire
from snakesim_can_backend.can_drives.backend import CanDriveBackend
from snakesim_can_backend.can_drives.emulator import CanEmulatorContext
from snakesim_can_backend.driver.backend import CanBackend
from snakesim_can_backend.emulator.chain import ModuleChain
from snakesim_can_backend.emulator.server import EmulatorServer
from snakesim_can_backend.protocol.definitions import FROM_HOST, ModuleState
from snakesim_drivers.emulation.emulated_body import EmulatedBody
from snakesim_drivers.emulation.shared_physics import make_physics_model
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_drivers.kit.drive_settings import make_emulated_body
from snakesim_drivers.kit.drive_type import DriverTypeBackend, DriverTypePart
from snakesim_drivers.motion_capture.emulated_mocap import PoseSender
from snakesim_hal.base.process import (
    SERVICE_PRIORITY,
    call_on_stop_signals,
    set_parent_death_signal,
    tune_garbage_collector,
)
from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.plugins import BACKENDS, load_plugin
from snakesim_hal.model.scenario import RunConfig, load_scenario
from snakesim_hal.programs.preflight import decode_backend_settings
from snakesim_serial_backend.emulation import create_named_ptys
from snakesim_serial_backend.servo_backend import ServoBackend
from snakesim_serial_backend.wire import PseudoTerminal
from snakesim_testing.benches.emulated_drives import list_enabled_drives

CYCLE_PAUSE_S = 0.0005  # a fortieth of the control period of the rows that use this process
READY = "drives ready"  # printed once the buses are open
ENABLED_STATES = (ModuleState.ARMED, ModuleState.STOPPING)


@dataclass(frozen=True)
class EmulatedDrives:
    """Emulated drives on their buses.

    Attributes:
        run_due: Processes the frames that have arrived, and the timers that have expired.
        list_enabled: Returns for each joint, from tail to head, whether its drive is enabled.
    """

    run_due: Callable[[], object]
    list_enabled: Callable[[], list[bool]]


def main(argv: Sequence[str] | None = None) -> int:
    """Emulate the drives, and record each change, until a stop signal."""
    arguments = _parse_arguments(argv)
    set_parent_death_signal(arguments.parent)
    running = [True]  # empty after a stop signal
    call_on_stop_signals(running.clear)
    with ExitStack() as stack, arguments.record.open("w", buffering=1) as record:
        config = load_scenario(arguments.config).config
        drives = open_drives(config, arguments.pose, stack)
        tune_garbage_collector()
        with contextlib.suppress(OSError):  # real drives do not wait for a busy computer
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(SERVICE_PRIORITY))
        print_line(READY)
        last_enabled: list[bool] = []
        while running:
            drives.run_due()
            enabled = drives.list_enabled()
            if enabled != last_enabled:
                record.write(json.dumps([time.monotonic_ns(), enabled]) + "\n")
                last_enabled = enabled
            time.sleep(CYCLE_PAUSE_S)
    return 0


def open_drives(config: RunConfig, pose: str, stack: ExitStack) -> EmulatedDrives:
    """Open the buses of a configuration, and emulate its drives on them.

    Args:
        config: Configuration of the run.
        pose: Address HOST:PORT that gets the emulated motion capture.
        stack: Closes the buses.
    """
    backend: Any = load_plugin(BACKENDS, config.backend)
    settings = decode_backend_settings(config, backend)
    if backend is CanBackend:
        return _open_joint_modules(config, settings, pose, stack)
    parts: list[DriverTypePart] = backend.group_joints_by_driver_type(config, settings)
    body = make_emulated_body(config, settings, config.backend, pose)
    clock = DriverClock(config)
    emulators = [
        _make_emulator(part, body.select(list(part.joints)), clock, stack) for part in parts
    ]

    def run_due() -> None:
        for run_emulator in emulators:
            run_emulator()

    def list_enabled() -> list[bool]:
        enabled_by_joint: dict[int, bool] = {}
        for part, emulator in zip(parts, emulators, strict=True):
            enabled = list_enabled_drives(emulator)
            enabled_by_joint |= dict(zip(part.joints, enabled, strict=True))
        return [enabled_by_joint[joint] for joint in range(len(enabled_by_joint))]

    return EmulatedDrives(run_due, list_enabled)


def _make_emulator(
    part: DriverTypePart, body: EmulatedBody, clock: DriverClock, stack: ExitStack
) -> Any:
    """Return an emulator of the drives of one driver type. All of them are on its first bus."""
    driver_type: type[DriverTypeBackend] = part.driver_type
    joints = list(part.joints.values())
    if issubclass(driver_type, CanDriveBackend):
        bus = open_wire(part.ports[0], None, part.settings.bit_rate, part.settings.fd_rate)
        buses = [bus] * len(joints)
        context = CanEmulatorContext(joints, part.settings, body, buses, clock.now_ns)
        return stack.enter_context(closing(driver_type.emulator_class(context)))
    assert issubclass(driver_type, ServoBackend), (
        f"no separate process can emulate {driver_type.name}"
    )
    ptys: list[PseudoTerminal] = stack.enter_context(create_named_ptys([Path(part.ports[0])]))
    return driver_type.make_emulator(joints, part.settings, body, ptys * len(joints), clock)


def _open_joint_modules(
    config: RunConfig, settings: Any, pose: str, stack: ExitStack
) -> EmulatedDrives:
    """Emulate joint modules on the channels of the backend `can`."""
    wires = [
        stack.enter_context(closing(open_wire(channel, FROM_HOST, settings.bit_rate)))
        for channel in settings.channels
    ]
    send_pose = stack.enter_context(closing(PoseSender(pose)))
    physics_model = make_physics_model(config, settings, config.backend)
    chain = ModuleChain(config, settings, physics_model, is_stepped=False, send_pose=send_pose)
    server = EmulatorServer(wires, chain)

    def run_due() -> None:
        server.run_due(time.monotonic_ns())

    def list_enabled() -> list[bool]:
        return [slot.module.state in ENABLED_STATES for slot in chain.slots]

    return EmulatedDrives(run_due, list_enabled)


def _parse_arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("config", help="configuration of the run")
    parser.add_argument("record", type=Path, help="file for the changes")
    parser.add_argument("--pose", required=True, help="HOST:PORT of the motion capture")
    parser.add_argument("--parent", type=int, required=True, help="end together with this process")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
