"""The emulated drives of a backend under test, for clauses about what drives do without their driver."""

from contextlib import ExitStack
from typing import Any

from snakesim_can_backend.moteus.emulator import EmulatedMoteus
from snakesim_can_backend.moteus.protocol import MoteusMode
from snakesim_can_backend.odrive.emulator import EmulatedOdrive
from snakesim_can_backend.odrive.protocol import AxisState
from snakesim_can_backend.protocol.definitions import ModuleState
from snakesim_serial_backend.dynamixel import registers as at
from snakesim_serial_backend.dynamixel.emulator import EmulatedDynamixel
from snakesim_serial_backend.feetech.emulator import EmulatedFeetech
from snakesim_testing.can.driver_loop import chain_of

POLL_S = 0.02


class DrivesOfAnyFamily:
    """Drives of the driver kit, on one bus or on several: a `snakesim_testing.contract.bench.EmulatedDrives`."""

    def __init__(self, backend: Any) -> None:
        self._backend, self._buses = backend, backend._drives.buses

    def enabled(self) -> list[bool]:
        found: dict[int, bool] = {}
        for bus in self._buses:
            found |= dict(zip(bus.spec.joints, enabled_drives(bus.drives._emulator), strict=True))
        return [found[joint] for joint in range(len(found))]

    def freeze_driver(self, seconds: float, sleep: Any) -> None:
        with ExitStack() as held:
            for bus in self._buses:
                if hasattr(bus, "_condition"):  # a bus in a thread: it can do nothing without this
                    held.enter_context(bus._condition)
            self._backend._clock.robot_ns += round(seconds * 1e9)
            sleep(seconds)
            for bus in self._buses:
                bus.drives._emulator()


class DrivesOfModules:
    """Joint modules on a virtual bus."""

    def __init__(self, backend: Any) -> None:
        self._chain = chain_of(backend)

    def enabled(self) -> list[bool]:
        driven = ModuleState.ARMED, ModuleState.STOPPING
        return [slot.module.state in driven for slot in self._chain.slots]

    def freeze_driver(self, seconds: float, sleep: Any) -> None:
        sleep(seconds)
        assert self._chain._sync_time is not None
        self._chain._step_to(self._chain._sync_time + round(seconds * 1e6))


def enabled_drives(emulator: Any) -> list[bool]:
    """Of the emulated drives of one driver type, those that would follow a setpoint."""
    match emulator:
        case EmulatedOdrive():
            return [axis.state == AxisState.CLOSED_LOOP for axis in emulator.axes]
        case EmulatedMoteus():
            return [controller.mode == MoteusMode.POSITION for controller in emulator.controllers]
        case EmulatedDynamixel():
            return [servo.on and servo.table[at.WATCHDOG] != at.TRIPPED for servo in emulator.servos]
        case EmulatedFeetech():
            return [servo.on for servo in emulator.servos]
        case _:
            raise TypeError(f"drives of an unknown driver type: {emulator}")
