"""Minimal drivers that break the contract, each in one way, with the contract tests that must fail on them."""

from collections.abc import Callable, Sequence
from typing import Any

from snakesim_drivers.kit.bus import BusSpec
from snakesim_drivers.kit.drive_type import DriverTypeContext, make_bus_specs_by_port
from snakesim_drivers.kit.drives import BusCommand
from snakesim_drivers.kit.findings import FaultFinding
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_drivers.template.minimal_driver import (
    NO_SETPOINT,
    MinimalBackend,
    MinimalDrives,
    MinimalEmulator,
    Report,
)
from snakesim_testing.benches.mutant import Mutant, make_test_names
from snakesim_testing.contract.kit_drives import KitDrives, mute_joint

DRIVER_MUTANTS: list[Mutant] = []
LATE_CYCLES = 10

BRAKES = "a_fault_brakes_a_moving_joint"
IN_TIME = "torque_is_off_in_time_by_the_drives_own_log"
AFTER_WATCHDOG = "torque_is_off_after_watchdog_by_the_drives_own_log"
RESTARTED = "a_drive_restarted_in_motion_stays_off_until_reset"
DUPLICATE = "two_drives_with_one_id_stop_the_robot"
UNGUARDED = "drives_without_watchdog_are_off_once_frozen_host_resumes"
BUS_LOST = "a_bus_that_is_lost_and_restored_enables_no_drive"
SUPPLY = "supply_and_temperatures_are_in_volts_and_degrees"
SAGGING = "a_sagging_supply_is_reported_at_its_joint"


def register_driver_mutant(*clauses: str, declares_watchdog: bool = True) -> Callable[[Any], Any]:
    """Return a decorator that registers a broken driver, or broken emulated drives, with the tests that must fail.

    Args:
        clauses: Names of the contract tests that must fail, without `test_`.
        declares_watchdog: Whether the driver type declares that its drives have a watchdog.
    """

    def register(broken: Any) -> Any:
        drives_type = broken if issubclass(broken, MinimalDrives) else MinimalDrives
        emulator_type = broken if issubclass(broken, MinimalEmulator) else MinimalEmulator

        class Broken(MinimalBackend):
            name = broken.__name__
            has_watchdog = declares_watchdog

            @classmethod
            def plan_buses(cls, context: DriverTypeContext) -> list[BusSpec]:
                def open_drives(
                    port: str, joint_indices: Sequence[int], readings: DriveReadings
                ) -> MinimalDrives:
                    assert context.body is not None
                    clock_ns = context.clock.now_ns
                    emulator = emulator_type(context.body, clock_ns, context.settings.watchdog_s)
                    joints = [context.joints[j] for j in joint_indices]
                    return drives_type(
                        emulator, joints, readings, clock_ns, context.config.period_ns
                    )

                return make_bus_specs_by_port(
                    context.joints, context.settings, ["memory"], open_drives
                )

        DRIVER_MUTANTS.append(
            Mutant(
                name=broken.__name__,
                backend=Broken,
                breaks=make_test_names(clauses),
                mute_joint=mute_joint,
                make_emulated_drives=KitDrives,
            )
        )
        return broken

    return register


@register_driver_mutant(SUPPLY)
class VoltageInWrongUnit(MinimalDrives):
    """Stores the supply voltage in a wrong unit."""

    def _store_report(self, i: int, report: Report) -> None:
        super()._store_report(i, report._replace(voltage_v=report.voltage_v * 1.5))


@register_driver_mutant(SUPPLY)
class FahrenheitTemperatures(MinimalDrives):
    """Stores the temperatures in degrees Fahrenheit."""

    def _store_report(self, i: int, report: Report) -> None:
        super()._store_report(i, report._replace(motor_c=report.motor_c * 1.8 + 64.0))


@register_driver_mutant(SAGGING)
class SupplyReadOnce(MinimalDrives):
    """Reads the supply voltage only once."""

    first_v: float | None = None

    def _store_report(self, i: int, report: Report) -> None:
        if self.first_v is None:
            self.first_v = report.voltage_v
        super()._store_report(i, report._replace(voltage_v=self.first_v))


@register_driver_mutant(IN_TIME)
class SwitchesOffLate(MinimalDrives):
    """Switches drives off some cycles after the command."""

    late_cycles = 0

    def send_setpoints(self, command: BusCommand) -> None:
        if command.enabled_drives:
            self.late_cycles = 0
            super().send_setpoints(command)
            return
        self.late_cycles += 1
        still_following = frozenset(i for i in self.all_drives if self.emulator.drives[i].enabled)
        if self.late_cycles < LATE_CYCLES:
            command = command._replace(enabled_drives=still_following)
        super().send_setpoints(command)


@register_driver_mutant(BRAKES)
class FollowsOldSetpointsAfterFault(MinimalDrives):
    """Sends the last setpoints from before a fault again, instead of those that brake."""

    armed_command: BusCommand | None = None

    def send_setpoints(self, command: BusCommand) -> None:
        if command.may_enable:
            self.armed_command = command
        elif self.armed_command is not None and not command.emergency:
            command = self.armed_command._replace(
                enabled_drives=command.enabled_drives, may_enable=False
            )
        super().send_setpoints(command)


@register_driver_mutant(AFTER_WATCHDOG, BUS_LOST)
class HasNoWatchdogAtAll(MinimalEmulator):
    """Emulates drives that follow their last setpoint forever."""

    def on_step(self, now_us: float) -> None:
        for drive in self.drives:
            drive.watchdog_fed_us = now_us
        super().on_step(now_us)


@register_driver_mutant(UNGUARDED, declares_watchdog=False)
class ContinuesAfterPause(HasNoWatchdogAtAll):
    """Emulates drives without a watchdog. Their driver does not detect that its host was frozen."""


@register_driver_mutant(AFTER_WATCHDOG)
class HasASlowWatchdog(MinimalEmulator):
    """Emulates drives that switch off later than the time of their watchdog."""

    def __init__(self, *parts: Any) -> None:
        super().__init__(*parts)
        self._watchdog_us *= 5


class AnswersForSilentDrives(MinimalDrives):
    """Reports the last values of a silent drive as new, so that its silence is not detected."""

    def read(self) -> None:
        super().read()
        for i in self.all_drives:
            self.readings.set_motion(
                i, float(self.readings.angle_rad[i]), float(self.readings.velocity_rad_s[i])
            )
            self.readings.set_torque(i, float(self.readings.torque_nm[i]))


@register_driver_mutant(RESTARTED)
class EnablesRestartedDrives(AnswersForSilentDrives):
    """Enables each drive that should follow again in every cycle."""

    def send_setpoints(self, command: BusCommand) -> None:
        super().send_setpoints(command)
        for i in command.enabled_drives:
            self.emulator.handle_message(i, "enable")

    def list_findings(self) -> list[FaultFinding]:
        return [finding for finding in super().list_findings() if finding.what != "drive_not_armed"]


@register_driver_mutant(DUPLICATE)
class IgnoresSecondDriveWithSameId(MinimalDrives):
    """Does not report a second drive with the same id."""

    def list_findings(self) -> list[FaultFinding]:
        return [finding for finding in super().list_findings() if finding.what != "duplicate_node"]


@register_driver_mutant(DUPLICATE)
class ForgetsSecondDriveAfterReset(MinimalDrives):
    """Does not report a second drive with the same id again after a reset, although it still exists."""

    is_forgotten = False

    def reset_faults(self, joints: frozenset[int]) -> None:
        super().reset_faults(joints)
        self.is_forgotten = True

    def list_findings(self) -> list[FaultFinding]:
        findings = super().list_findings()
        return [
            finding
            for finding in findings
            if not (self.is_forgotten and finding.what == "duplicate_node")
        ]


@register_driver_mutant(BUS_LOST)
class EnablesDrivesOfRestoredBus(MinimalDrives):
    """Clears errors and enables all drives after the bus is restored, in every lifecycle state."""

    was_cut = False

    def send_setpoints(self, command: BusCommand) -> None:
        super().send_setpoints(command)
        if self.was_cut and not self.emulator.is_cut:
            for i in self.all_drives:
                self.emulator.handle_message(i, "clear_error")
                self.emulator.handle_message(i, NO_SETPOINT)
                self.emulator.handle_message(i, "enable")
        self.was_cut |= self.emulator.is_cut
