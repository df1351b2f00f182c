"""Observes the joint modules of the reference firmware in C by the output of its program, a child of the driver."""

import re
from typing import Any

from snakesim_drivers.emulation.emulator_child import EmulatorChild
from snakesim_testing.contract.bench import TorqueSwitch
from snakesim_testing.harness.wait import wait_until

SWITCH_PATTERN = re.compile(r"^([0-9.]+) joint_([0-9]+) torque (on|off)$", re.MULTILINE)
TIME_PATTERN = re.compile(r"^([0-9.]+) time$", re.MULTILINE)


class FirmwareDrives:
    """The modules of an open backend whose clock mode is lockstep."""

    def __init__(self, backend: Any) -> None:
        self._child: EmulatorChild = backend.modules._emulator_process._child
        self._joint_count = len(backend.describe().joints)

    def list_enabled(self) -> list[bool]:
        self.read_time_s()
        enabled = [False] * self._joint_count
        for switch in self.list_torque_switches():
            enabled[switch.joint] = switch.is_on
        return enabled

    def freeze_driver(self, seconds: float, sleep: Any) -> None:
        sleep(seconds)
        self._advance(seconds)

    def read_time_s(self) -> float:
        return self._advance(0.0)

    def list_torque_switches(self) -> list[TorqueSwitch]:
        return [
            TorqueSwitch(float(time_s), int(number) - 1, is_on=switch == "on")
            for time_s, number, switch in SWITCH_PATTERN.findall(self._child.read_output())
        ]

    def _advance(self, seconds: float) -> float:
        """Advance the time of the modules, and return it in s. The program has printed all earlier switches by then."""
        known_count = len(TIME_PATTERN.findall(self._child.read_output()))
        self._child.write_line(f"advance {seconds:g}")
        wait_until(
            lambda: len(TIME_PATTERN.findall(self._child.read_output())) > known_count,
            "the time of the modules",
        )
        return float(TIME_PATTERN.findall(self._child.read_output())[-1])
