"""Sensors with messages of their own: every number now, and over the last seconds, as their robot describes them."""

import math
from collections import deque

import numpy as np
import viser

from snakesim_hal.wire.own_sample import OwnKind, own_kinds
from snakesim_operator.features.console.page.joint_charts import HISTORY_S, SAMPLES_MOST, keep, over_time
from snakesim_operator.features.console.page.page_html import plain, table
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot

MOST_CHARTS, MOST_LINES = 8, 16


def numbers(snapshot: RobotSnapshot) -> dict[tuple[str, str], dict[str, float]]:
    """By field and unit, then by sensor: `left`, or `left.0` of a list."""
    found: dict[tuple[str, str], dict[str, float]] = {}
    for key, kind in own_kinds(snapshot.robot).items():
        if (sample := snapshot.own.get(key)) is not None:
            for name, value in kind.numbers(sample).items():
                field, dot, part = name.partition(".")
                lines = found.setdefault((field, kind.units[field]), {})
                lines[f"{key.rpartition('/')[2]}{dot}{part}"] = value
    return found


def sensor_table(snapshot: RobotSnapshot) -> str:
    """What each of them says now, and how old it is."""
    rows: list[tuple[str, str]] = []
    for key, kind in own_kinds(snapshot.robot).items():
        sample, stream = snapshot.own.get(key), snapshot.streams.get(key)
        if sample is None:
            rows.append((plain(key), "nothing yet"))
            continue
        age = "" if stream is None or stream.age_s is None else f", {stream.age_s * 1e3:.0f} ms old"
        rows.append((plain(key), f"{plain(kind.message.__name__)} on link {sample.link}{age}"))
        rows += [(plain(name), _value(kind, name, value)) for name, value in kind.numbers(sample).items()]
    return table(rows)


def _value(kind: OwnKind, name: str, value: float) -> str:
    unit = kind.units[name.partition(".")[0]]
    return "unknown" if math.isnan(value) else plain(f"{value:.4g}{'' if unit == '1' else ' ' + unit}")


class CustomSensorCharts:
    """A table, and a chart for each field, with a line for each sensor that has it."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._gui = gui
        self._text = gui.add_html("")
        self._charts: dict[tuple[str, str], tuple[list[str], viser.GuiUplotHandle]] = {}
        self._history: dict[tuple[str, str], deque[tuple[float, dict[str, float]]]] = {}

    def take(self, snapshot: RobotSnapshot) -> None:
        """Keep a sample for the charts; each frame."""
        time_s = snapshot.time_s
        if time_s is None:
            return
        for what, lines in numbers(snapshot).items():
            keep(self._history.setdefault(what, deque(maxlen=SAMPLES_MOST)), (time_s, lines))

    def show(self, snapshot: RobotSnapshot) -> None:
        """Redraw; a few times a second."""
        self._text.content = sensor_table(snapshot)
        for what, kept in list(self._history.items())[:MOST_CHARTS]:
            names = list(kept[-1][1])[:MOST_LINES]
            if what not in self._charts or self._charts[what][0] != names:
                self._add(what, names)
            samples = [sample for sample in kept if sample[0] >= kept[-1][0] - HISTORY_S]
            columns = [np.array([lines.get(name, math.nan) for _, lines in samples]) for name in names]
            self._charts[what][1].data = (np.array([time_s for time_s, _ in samples]), *columns)

    def _add(self, what: tuple[str, str], names: list[str]) -> None:
        if what in self._charts:
            self._charts.pop(what)[1].remove()
        title = f"{what[0]}, last {HISTORY_S:g} s, {what[1]}"
        self._charts[what] = names, over_time(self._gui, names, title)

    def remove(self) -> None:
        """Take everything off the page: another robot."""
        for _, chart in self._charts.values():
            chart.remove()
        self._text.remove()
