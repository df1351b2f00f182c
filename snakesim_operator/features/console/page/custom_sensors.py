"""Custom sensors: every number now, and over the last seconds, with the units that their robot describes."""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import viser

from snakesim_hal.wire.custom_sample import CustomMessage, find_custom_messages
from snakesim_operator.features.console.page.joint_charts import (
    HISTORY_S,
    MAX_SAMPLES,
    add_history_chart,
    append_sample,
)
from snakesim_operator.features.console.page.page_html import escape_text, format_table
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot

MAX_CHARTS = 8
MAX_LINES = 16  # of one chart


@dataclass(frozen=True)
class SensorQuantity:
    """A field of custom sensor messages; sensors that publish the same quantity share a chart."""

    field: str
    unit: str


def collect_numbers(snapshot: RobotSnapshot) -> dict[SensorQuantity, dict[str, float]]:
    """Return the numbers of all custom sensors by quantity, then by sensor: `left`, or `left.0` of a list."""
    numbers: dict[SensorQuantity, dict[str, float]] = {}
    for key, kind in find_custom_messages(snapshot.robot).items():
        sample = snapshot.custom.get(key)
        if sample is None:
            continue
        sensor = key.rpartition("/")[2]
        for name, value in kind.extract_numeric_values(sample).items():
            field, dot, part = name.partition(".")
            quantity = SensorQuantity(field, kind.units[field])
            numbers.setdefault(quantity, {})[f"{sensor}{dot}{part}"] = value
    return numbers


def format_sensor_table(snapshot: RobotSnapshot) -> str:
    """Return a table of each sensor's newest message and its age."""
    rows: list[tuple[str, str]] = []
    for key, kind in find_custom_messages(snapshot.robot).items():
        sample = snapshot.custom.get(key)
        if sample is None:
            rows.append((escape_text(key), "nothing yet"))
            continue
        message_type = escape_text(kind.message.__name__)
        rows.append(
            (escape_text(key), f"{message_type} on link {sample.link}{_format_age(snapshot, key)}")
        )
        for name, value in kind.extract_numeric_values(sample).items():
            rows.append((escape_text(name), _format_value(kind, name, value)))
    return format_table(rows)


def _format_age(snapshot: RobotSnapshot, key: str) -> str:
    stream = snapshot.streams.get(key)
    if stream is None or stream.age_s is None:
        return ""
    return f", {stream.age_s * 1e3:.0f} ms old"


def _format_value(kind: CustomMessage, name: str, value: float) -> str:
    if math.isnan(value):
        return "unknown"
    unit = kind.units[name.partition(".")[0]]
    suffix = "" if unit == "1" else f" {unit}"
    return escape_text(f"{value:.4g}{suffix}")


@dataclass
class _QuantityChart:
    line_names: Sequence[str]
    handle: viser.GuiUplotHandle


class CustomSensorCharts:
    """A table, and a chart for each quantity with a line for each sensor that publishes it."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._gui = gui
        self._table = gui.add_html("")
        self._charts: dict[SensorQuantity, _QuantityChart] = {}
        self._history: dict[SensorQuantity, deque[tuple[float, dict[str, float]]]] = {}

    def add_snapshot(self, snapshot: RobotSnapshot) -> None:
        """Keep a sample for the charts; called for each frame."""
        time_s = snapshot.time_s
        if time_s is None:
            return
        for quantity, numbers in collect_numbers(snapshot).items():
            history = self._history.setdefault(quantity, deque(maxlen=MAX_SAMPLES))
            append_sample(history, (time_s, numbers))

    def redraw(self, snapshot: RobotSnapshot) -> None:
        """Redraw the table and the charts; called a few times a second."""
        self._table.content = format_sensor_table(snapshot)
        for quantity in list(self._history)[:MAX_CHARTS]:
            self._show_chart(quantity)

    def _show_chart(self, quantity: SensorQuantity) -> None:
        history = self._history[quantity]
        newest_s, newest = history[-1]
        line_names = list(newest)[:MAX_LINES]
        chart = self._charts.get(quantity)
        if chart is None or chart.line_names != line_names:
            chart = self._replace_chart(quantity, line_names)
        samples = [
            (time_s, numbers) for time_s, numbers in history if time_s >= newest_s - HISTORY_S
        ]
        times_s = np.array([time_s for time_s, _ in samples])
        columns = [
            np.array([numbers.get(name, math.nan) for _, numbers in samples]) for name in line_names
        ]
        chart.handle.data = (times_s, *columns)

    def _replace_chart(self, quantity: SensorQuantity, line_names: Sequence[str]) -> _QuantityChart:
        """Add a chart with these lines in the place of the one that has other lines."""
        former = self._charts.pop(quantity, None)
        if former is not None:
            former.handle.remove()
        title = f"{quantity.field}, last {HISTORY_S:g} s, {quantity.unit}"
        chart = _QuantityChart(line_names, add_history_chart(self._gui, line_names, title))
        self._charts[quantity] = chart
        return chart

    def remove(self) -> None:
        """Remove everything from the page, because it shows another robot now."""
        for chart in self._charts.values():
            chart.handle.remove()
        self._table.remove()
