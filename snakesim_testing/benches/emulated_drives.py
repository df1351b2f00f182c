"""Observes the emulated drives of a backend under test, for contract tests of what drives do without their driver."""

from typing import Any

from snakesim_can_backend.protocol.definitions import ModuleState
from snakesim_drivers.template.minimal_driver import MinimalDrives
from snakesim_testing.can.driver_loop import find_chain
from snakesim_testing.contract.bench import TorqueSwitch
from snakesim_testing.contract.kit_drives import KitDrives


class DrivesOfAnyType(KitDrives):
    """The emulated drives of any driver type that is part of SnakeSIM."""

    def find_emulator(self, drives: Any) -> Any:
        if isinstance(drives, MinimalDrives):
            return drives.emulator
        return drives._emulator

    def list_enabled_of_bus(self, emulator: Any) -> list[bool]:
        return list_enabled_drives(emulator)


class ModuleDrives:
    """The emulated joint modules on a virtual bus."""

    DRIVEN = (ModuleState.ARMED, ModuleState.STOPPING)

    def __init__(self, backend: Any) -> None:
        """Log from now on which modules drive their motors, after each poll of a module."""
        self._chain = find_chain(backend)
        self._is_on = self.list_enabled()
        self._log: list[TorqueSwitch] = []
        follow_module = self._chain._apply_module_outputs

        def follow_and_log(slot: Any) -> None:
            follow_module(slot)
            is_on = slot.module.state in self.DRIVEN
            if slot.drives and is_on != self._is_on[slot.joint]:
                self._is_on[slot.joint] = is_on
                self._log.append(TorqueSwitch(self.read_time_s(), slot.joint, is_on=is_on))

        self._chain._apply_module_outputs = follow_and_log

    def list_enabled(self) -> list[bool]:
        return [slot.module.state in self.DRIVEN for slot in self._chain.slots if slot.drives]

    def freeze_driver(self, seconds: float, sleep: Any) -> None:
        sleep(seconds)
        assert self._chain._last_sync_time is not None
        self._chain._advance_to_sync(self._chain._last_sync_time + round(seconds * 1e6))

    def read_time_s(self) -> float:
        return self._chain.now_us * 1e-6

    def list_torque_switches(self) -> list[TorqueSwitch]:
        return list(self._log)


def list_enabled_drives(emulator: Any) -> list[bool]:
    """Return whether each emulated drive of a driver type would follow a setpoint."""
    return emulator.list_enabled()
