"""Emulated drives of any type in a process of their own, which notes when each of them was enabled and disabled.

`python -m verification.faults.drives_process CONFIG NOTES --pose HOST:PORT`: on the buses that the configuration names.
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

PAUSE_S = 0.0005
READY = "drives ready"
DRIVEN = (ModuleState.ARMED, ModuleState.STOPPING)


@dataclass(frozen=True)
class DriveProcesses:
    """Drives on their buses: what lets them run, and which of them are enabled, tail to head."""

    run: Callable[[], object]
    enabled: Callable[[], list[bool]]


def main(argv: Sequence[str] | None = None) -> int:
    """Until a stop signal."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("config")
    parser.add_argument("notes", type=Path)
    parser.add_argument("--pose", required=True)
    parser.add_argument("--parent", type=int, required=True)
    arguments = parser.parse_args(argv)
    set_parent_death_signal(arguments.parent)
    running = [True]
    call_on_stop_signals(running.clear)
    with ExitStack() as opened, arguments.notes.open("w", buffering=1) as notes:
        drives = open_drives(load_scenario(arguments.config).config, arguments.pose, opened)
        tune_garbage_collector()
        with contextlib.suppress(OSError):  # real drives do not wait for a busy computer
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(SERVICE_PRIORITY))
        print_line(READY)
        before: list[bool] = []
        while running:
            drives.run()
            if (now := drives.enabled()) != before:
                before = now
                notes.write(json.dumps([time.monotonic_ns(), now]) + "\n")
            time.sleep(PAUSE_S)
    return 0


def open_drives(config: RunConfig, pose: str, opened: ExitStack) -> DriveProcesses:
    """Open the buses of a configuration, and put its drives on them."""
    backend: Any = load_plugin(BACKENDS, config.backend)
    settings = decode_backend_settings(config, backend)
    if backend is CanBackend:
        return _modules(config, settings, pose, opened)
    parts: list[DriverTypePart] = backend.group_joints_by_driver_type(config, settings)
    body, clock = make_emulated_body(config, settings, config.backend, pose), DriverClock(config)
    emulators = [_emulator(part, body.select(list(part.joints)), clock, opened) for part in parts]

    def run() -> None:
        for emulator in emulators:
            emulator()

    def enabled() -> list[bool]:
        found: dict[int, bool] = {}
        for part, emulator in zip(parts, emulators, strict=True):
            found |= dict(zip(part.joints, list_enabled_drives(emulator), strict=True))
        return [found[joint] for joint in range(len(found))]

    return DriveProcesses(run, enabled)


def _emulator(
    part: DriverTypePart, body: EmulatedBody, clock: DriverClock, opened: ExitStack
) -> Any:
    """The emulated drives of one driver type, all on its first bus."""
    driver_type: type[DriverTypeBackend] = part.driver_type
    joints = list(part.joints.values())
    if issubclass(driver_type, CanDriveBackend):
        wire = open_wire(part.ports[0], None, part.settings.bit_rate, part.settings.fd_rate)
        context = CanEmulatorContext(
            joints, part.settings, body, [wire] * len(joints), clock.now_ns
        )
        return opened.enter_context(closing(driver_type.emulator_class(context)))
    assert issubclass(driver_type, ServoBackend), f"no emulator of {driver_type.name} as a process"
    ptys: list[PseudoTerminal] = opened.enter_context(create_named_ptys([Path(part.ports[0])]))
    return driver_type.make_emulator(joints, part.settings, body, ptys * len(joints), clock)


def _modules(config: RunConfig, settings: Any, pose: str, opened: ExitStack) -> DriveProcesses:
    wires = [
        opened.enter_context(closing(open_wire(c, FROM_HOST, settings.bit_rate)))
        for c in settings.channels
    ]
    send_pose = opened.enter_context(closing(PoseSender(pose)))
    physics_model = make_physics_model(config, settings, config.backend)
    chain = ModuleChain(config, settings, physics_model, is_stepped=False, send_pose=send_pose)
    server = EmulatorServer(wires, chain)
    return DriveProcesses(
        lambda: server.run_due(time.monotonic_ns()),
        lambda: [slot.module.state in DRIVEN for slot in chain.slots],
    )


if __name__ == "__main__":
    sys.exit(main())
