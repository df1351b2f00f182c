"""Gives the contract suite access to the emulated drives of a backend on the driver kit.

Pass `KitDrives` to `--snakesim-drives` or to a `Bench`, and `mute_joint` as `mute`, if the drives of each bus have an
attribute `emulator`, a `DriveEmulator` that implements `list_enabled`.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

from snakesim_hal.model.fault_kinds import parse_injection
from snakesim_testing.contract.bench import TorqueSwitch


def mute_joint(backend: Any, joint_index: int) -> None:
    """Let the emulated drive of a joint send nothing from now on."""
    assert backend.inject(parse_injection(f"mute:joint_{joint_index + 1}@0"), begins=True)


class KitDrives:
    """The emulated drives on all buses of a backend, as `snakesim_testing.contract.bench.EmulatedDrives`."""

    def __init__(self, backend: Any) -> None:
        """Log from now on which drives are enabled, in every step of their physics. Make one object for a backend."""
        self._backend = backend
        self._buses = backend._drives.buses
        self._log: list[TorqueSwitch] = []
        for bus in self._buses:
            emulator = self.find_emulator(bus.drives)
            is_on = self.list_enabled_of_bus(emulator)
            emulator.body.add_step_callback(
                partial(self._log_switches, emulator, bus.spec.joints, is_on)
            )

    def find_emulator(self, drives: Any) -> Any:
        """Return the emulated drives of a bus.

        Raises:
            AttributeError: The drives have no attribute `emulator`.
        """
        if not hasattr(drives, "emulator"):
            raise AttributeError(
                f"{type(drives).__name__} has no attribute `emulator` with its emulated drives. Add it, or pass a "
                "subclass of KitDrives with another `find_emulator`"
            )
        return drives.emulator

    def list_enabled_of_bus(self, emulator: Any) -> list[bool]:
        """Return for each emulated drive of a bus whether it would follow a setpoint."""
        return emulator.list_enabled()

    def list_enabled(self) -> list[bool]:
        """Return for each joint whether its drive would follow a setpoint now."""
        enabled_by_joint: dict[int, bool] = {}
        for bus in self._buses:
            enabled_on_bus = self.list_enabled_of_bus(self.find_emulator(bus.drives))
            enabled_by_joint |= dict(zip(bus.spec.joints, enabled_on_bus, strict=True))
        return [enabled_by_joint[joint] for joint in range(len(enabled_by_joint))]

    def freeze_driver(self, seconds: float, sleep: Callable[[float], None]) -> None:
        """Let time pass at the drives while nothing of the driver runs."""
        with self.hold_driver():
            self.pass_time(seconds, sleep)

    @contextmanager
    def hold_driver(self) -> Iterator[None]:
        """Let no thread of a bus begin another cycle."""
        with ExitStack() as held_locks:
            for bus in self._buses:
                if hasattr(bus, "_condition"):  # the thread of a bus waits for this lock
                    held_locks.enter_context(bus._condition)
            yield

    def pass_time(self, seconds: float, sleep: Callable[[float], None]) -> None:
        """Let time pass at the drives. The caller holds the driver."""
        self._backend._clock.robot_time_ns += round(seconds * 1e9)
        sleep(seconds)
        for bus in self._buses:
            self.find_emulator(bus.drives)()

    def read_time_s(self) -> float:
        """Return the drives' own time."""
        return self.find_emulator(self._buses[0].drives).body.now_us * 1e-6

    def list_torque_switches(self) -> list[TorqueSwitch]:
        """Return when each drive has switched its torque on and off, by the drives' own time."""
        return list(self._log)

    def _log_switches(
        self, emulator: Any, joints: tuple[int, ...], is_on: list[bool], now_us: float
    ) -> None:
        for i, enabled in enumerate(self.list_enabled_of_bus(emulator)):
            if enabled != is_on[i]:
                is_on[i] = enabled
                self._log.append(TorqueSwitch(now_us * 1e-6, joints[i], is_on=enabled))
