"""Signals of a run: values that were measured, applied and published in each tick, and values computed from them."""

from snakesim_operator.results.signals.signal_table import (
    compute_signals,
    get_recorded_signals,
    list_component_names,
    make_signal_columns,
    select_columns,
)
from snakesim_operator.results.signals.units import (
    CONTROLLER_SUFFIX,
    JOINT_SIGNALS,
    PARQUET_UNIT,
    UNITS,
    find_unit,
)

__all__ = [
    "CONTROLLER_SUFFIX",
    "JOINT_SIGNALS",
    "PARQUET_UNIT",
    "UNITS",
    "compute_signals",
    "find_unit",
    "get_recorded_signals",
    "list_component_names",
    "make_signal_columns",
    "select_columns",
]
