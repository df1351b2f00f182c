"""Every number of a recording over time, by name and unit: see `signals`."""

from typing import Any

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire import keys
from snakesim_operator.features.console.robot_data.run_playback import RunPlayback, get_timestamp_s
from snakesim_operator.features.console.robot_data.signals import (
    PREFIXED_MESSAGES,
    find_signal_unit,
    list_message_numbers,
)
from snakesim_operator.results.signals import find_unit, make_signal_columns

TimedNumbers = list[tuple[float, dict[str, float]]]  # robot time in s, and numbers by signal


class PlaybackSignals:
    """The signals of a whole recording."""

    recorded = True

    def __init__(self, run: RunPlayback) -> None:
        record = run.record
        self._begin_s, _ = run.span_s
        # Signals that are columns of the record.
        self._column_times_s = record.time_s - self._begin_s
        self._columns = {
            name: column for name, column in make_signal_columns(record).items() if name != "time_s"
        }
        self._units = {name: find_unit(name, record) for name in self._columns}
        # Signals from other messages; those of one message share a list.
        self._message_numbers: dict[str, TimedNumbers] = {}
        self._add_messages(
            run,
            keys.CONTROL_STATE,
            [(get_timestamp_s(state), state) for state in record.control_states],
        )
        self._add_messages(run, keys.POWER, list(run.history.iterate_messages(keys.POWER)))
        self._add_messages(run, keys.IMU, list(run.history.iterate_messages(keys.IMU)))

    def _add_messages(self, run: RunPlayback, key: str, messages: list[tuple[float, Any]]) -> None:
        """Add the signals of the messages of one key."""
        robot = run.record.description
        timed_numbers = [
            (time_s, list_message_numbers(message, robot)) for time_s, message in messages
        ]
        for _, numbers in timed_numbers:
            for name in numbers:
                if name not in self._message_numbers:
                    self._message_numbers[name] = timed_numbers
                    self._units[name] = find_signal_unit(name, PREFIXED_MESSAGES[key])

    def get_units(self) -> dict[str, str]:
        return self._units

    def read_series(self, name: str) -> tuple[Floats, Floats]:
        if name in self._columns:
            return self._column_times_s, np.asarray(self._columns[name], dtype=float)
        timed_numbers = self._message_numbers[name]
        times_s = np.array([time_s for time_s, _ in timed_numbers]) - self._begin_s
        values = np.array([numbers.get(name, np.nan) for _, numbers in timed_numbers])
        return times_s, values
