"""Answers of modules, read by the driver."""

from snakesim_can_backend.driver.reports import ModuleReports
from snakesim_testing.can.frames import syncs

JOINTS = 3


def reading(syncs_before: int = 5) -> ModuleReports:
    made = ModuleReports(JOINTS)
    syncs(made, syncs_before)
    return made


def angles(made: ModuleReports) -> list[float]:
    return made.shaft_values()[0].tolist()
