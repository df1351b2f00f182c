"""Makes the driver's record of what joint modules have reported."""

from snakesim_can_backend.driver.reports import ModuleReports
from snakesim_testing.can.frames import run_syncs

JOINT_COUNT = 3


def make_module_reports(answered_sync_count: int = 5) -> ModuleReports:
    """Return the reports of modules that have answered the first Syncs."""
    reports = ModuleReports(JOINT_COUNT)
    run_syncs(reports, answered_sync_count)
    return reports


def read_angles_rad(reports: ModuleReports) -> list[float]:
    """Return the joint angles that the modules have reported."""
    return reports.shaft_values()[0].tolist()
