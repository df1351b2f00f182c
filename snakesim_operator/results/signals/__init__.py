"""The signals of a run: what was measured, applied and published in each tick, and what follows from it."""

from snakesim_operator.results.signals.signal_table import arrays, name_parts, recorded_arrays, select_columns, table
from snakesim_operator.results.signals.units import CONTROLLER, OF_JOINTS, PARQUET_UNIT, UNITS, unit_of

__all__ = [
    "CONTROLLER",
    "OF_JOINTS",
    "PARQUET_UNIT",
    "UNITS",
    "arrays",
    "name_parts",
    "recorded_arrays",
    "select_columns",
    "table",
    "unit_of",
]
