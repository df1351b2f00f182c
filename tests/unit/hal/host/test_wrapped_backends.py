"""Backends around another one forward every call. A default of the base class would hide the inner result."""

import inspect

import pytest

from snakesim_hal.backend import Backend
from snakesim_hal.faults.faulty_backend import FaultyBackend
from snakesim_hal.host.guarded_backend import GuardedBackend

CLASS_METHODS = {
    "check",
    "limit_modes",
}  # these are called on the inner class, before a backend is opened


@pytest.mark.parametrize("wrapper", [FaultyBackend, GuardedBackend])
def test_wrapper_backend_forwards_every_method(wrapper: type[Backend]) -> None:
    methods = {
        name
        for name, _ in inspect.getmembers(Backend, inspect.isfunction)
        if not name.startswith("_")
    }
    missing = {name for name in methods - CLASS_METHODS if name not in vars(wrapper)}
    assert not missing
