"""Injects faults into emulated drives for clauses about the reaction of a backend."""

import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import parse_injection
from snakesim_testing.contract.rig import BackendRig


def inject_or_skip(rig: BackendRig, text: str) -> None:
    """Begin a fault of the emulated drives, or skip the clause if the backend cannot inject it."""
    try:
        is_possible = rig.backend.inject(parse_injection(text), begins=True)
    except ConfigError as error:
        pytest.skip(f"this backend does not have the fault {text.partition(':')[0]}: {error}")
    if not is_possible:
        pytest.skip(f"this backend does not have the fault {text.partition(':')[0]}")
