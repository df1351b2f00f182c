"""Every number of a recording over time, by name and unit: see `signals`."""

from typing import Any

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire import keys
from snakesim_operator.features.console.robot_data.recorded_run import RecordedRun
from snakesim_operator.features.console.robot_data.signals import PREFIXED, numbers, units
from snakesim_operator.playback.export import table, unit_of


class RecordedSignals:
    """Of a recording: all of it."""

    recorded = True

    def __init__(self, run: RecordedRun) -> None:
        record = run.record
        self._begin_s, self._time_s = run.span_s[0], record.time_s - run.span_s[0]
        self._columns = {name: column for name, column in table(record).items() if name != "time_s"}
        self._units = {name: unit_of(name, record) for name in self._columns}
        self._heard: dict[str, list[tuple[float, dict[str, float]]]] = {}
        told: dict[str, list[tuple[float, Any]]] = {
            keys.CONTROL_STATE: [((one.timestamp_ns or 0) * 1e-9, one) for one in record.control],
            keys.POWER: list(run.heard.every(keys.POWER)),
            keys.IMU: list(run.heard.every(keys.IMU)),
        }
        for key, messages in told.items():
            found = [(time_s, numbers(message, record.description)) for time_s, message in messages]
            for name in dict.fromkeys(name for _, one in found for name in one):
                self._heard[name] = found
                self._units[name] = units(PREFIXED[key])[name.split(".")[1]]

    def units(self) -> dict[str, str]:
        """Of every signal there is, by name."""
        return self._units

    def series(self, name: str) -> tuple[Floats, Floats]:
        """Times and values of one. Raises KeyError."""
        if name in self._columns:
            return self._time_s, np.asarray(self._columns[name], dtype=float)
        heard = self._heard[name]
        values = np.array([one.get(name, np.nan) for _, one in heard])
        return np.array([time_s for time_s, _ in heard]) - self._begin_s, values
