"""Backends around another pass on every call: a default of the base class would hide what the inner one answers."""

import inspect

import pytest

from snakesim_hal.backend import Backend
from snakesim_hal.faults.faulty_backend import FaultyBackend
from snakesim_hal.host.guarded_backend import GuardedBackend

OF_THE_CLASS = {"check", "limit_modes"}  # used before a backend is opened, on the inner class


@pytest.mark.parametrize("wrapper", [FaultyBackend, GuardedBackend])
def test_wrapped_backend_passes_on_every_method(wrapper: type[Backend]) -> None:
    methods = {
        name
        for name, _ in inspect.getmembers(Backend, inspect.isfunction)
        if not name.startswith("_")
    }
    missing = {name for name in methods - OF_THE_CLASS if name not in vars(wrapper)}
    assert not missing
