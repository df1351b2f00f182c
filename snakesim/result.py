"""The result of a run: signals by name with their units, metrics, and pages, plots and films of them."""

import dataclasses
import importlib
import math
import os
import sys
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from snakesim.chart import Chart, embed_in_iframe
from snakesim_hal.base.errors import ConfigError, shorten, suggest_word
from snakesim_hal.model.textfiles import write_text
from snakesim_operator.results.page.charts import ChartLine, make_line_chart
from snakesim_operator.results.run_ending import COMPLETE
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.signals import (
    compute_signals,
    find_unit,
    make_signal_columns,
    select_columns,
)
from snakesim_operator.results.summary import RunSummary, get_distance_m

PLAYBACK_HEIGHT_PX = 580
WHOLE_RUN_SPAN_S = (0.0, math.inf)  # start and end of a span that contains every run


@dataclasses.dataclass(frozen=True, eq=False)
class Result:
    """The signals and the summary of a run that is over.

    Every signal has a row for each tick since the first arming. NaN is unknown. `result["angle_rad"]` is
    (ticks, joints), `result["angle_rad.joint_3"]` is (ticks,), `result["link_force_l_n"]` is (ticks, links, 3).
    `signal_names` lists all signals.
    """

    record: RunRecord  # every tick, and the telemetry of control and guidance
    summary: RunSummary  # the content of `summary.json`

    @cached_property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """All signals by name, each (ticks,), (ticks, width), or (ticks, links or obstacles, 3)."""
        return compute_signals(self.record)

    @cached_property
    def columns(self) -> dict[str, NDArray[Any]]:
        """All signals split into columns by name, each (ticks,), as in the tables of `snakesim recording export`."""
        return make_signal_columns(self.record)

    @property
    def signal_names(self) -> list[str]:
        """The names of all signals and columns."""
        return list(self.arrays | self.columns)

    @cached_property
    def units(self) -> dict[str, str]:
        """The SI unit of each signal by its name. "1" for plain numbers."""
        return {name: find_unit(name, self.record) for name in self.signal_names}

    @property
    def joints(self) -> list[str]:
        """The names of the joints, tail to head, which are the second axis of signals such as `angle_rad`."""
        return [joint.name for joint in self.record.description.joints]

    @property
    def time_s(self) -> NDArray[np.float64]:
        """The robot time of each row in s, (ticks,)."""
        return self.record.time_s

    @cached_property
    def metrics(self) -> dict[str, float | bool | None]:
        """The numbers of the summary by name. Units are in the names. None is unknown."""
        metrics: dict[str, float | bool | None] = {}
        for name, value in msgspec.structs.asdict(self.summary).items():
            if value is None or isinstance(value, bool | int | float):
                metrics[name] = value
        return metrics

    @property
    def digest(self) -> str:
        """A hash of all applied setpoints. Two runs have the same hash if their setpoints are equal to the bit."""
        return self.summary.command_digest

    @property
    def status(self) -> str:
        """How the run ended: "complete", or the failure."""
        return self.summary.ended

    @property
    def complete(self) -> bool:
        """Whether the robot was armed for the whole duration."""
        return self.status == COMPLETE

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a signal, a column of a signal, or a part of a signal.

        Args:
            name: A name in `signal_names`, such as "angle_rad" or "angle_rad.joint_3", or a part of a signal, such as
                "link_force_l_n.head", which is (ticks, 3).

        Raises:
            ConfigError: There is no such signal.
        """
        if name in self.arrays:
            return self.arrays[name]
        selected_columns = select_columns(name, self.columns)
        if not selected_columns:
            raise ConfigError(
                f"no signal {shorten(str(name))!r}; {suggest_word(str(name), self.signal_names)}there are "
                f"{', '.join(self.arrays)}, and columns of them such as angle_rad.{self.joints[0]}: see `signal_names`",
                code="recording/unknown-signal",
            )
        if name in selected_columns:
            return selected_columns[name]
        return np.stack(list(selected_columns.values()), axis=1)

    def to_pandas(self) -> Any:
        """Return a pandas DataFrame of all columns, with the time in s as its index.

        Returns:
            The DataFrame; its `attrs["units"]` has the unit of each column.

        Raises:
            ConfigError: pandas is not installed.
        """
        try:
            pandas = importlib.import_module("pandas")
        except ImportError as error:
            raise ConfigError(
                f"to_pandas() needs pandas ({error}); install it with: {sys.executable} -m pip install pandas",
                code="extra/not-installed",
            ) from None
        frame = pandas.DataFrame(self.columns).set_index("time_s")
        frame.attrs["units"] = {name: self.units[name] for name in frame.columns}
        return frame

    def plot(self, *signals: str) -> Chart:
        """Return a chart of signals over time, which a notebook shows.

        Args:
            *signals: Names of signals, one figure each. Without names, angles and torques.

        Raises:
            ConfigError: There is no such signal.
        """
        figures = [self._make_figure(name) for name in signals or ("angle_rad", "torque_nm")]
        return Chart(self.summary.scenario, figures, len(self.joints))

    def report(self, path: str | os.PathLike[str]) -> Path:
        """Write the report of the run: one page of HTML that needs no network and no other file.

        Args:
            path: The file to write.

        Returns:
            The path of the file.

        Raises:
            ConfigError: The file cannot be written.
        """
        from snakesim_operator.results.report import render_report

        write_text(Path(path), render_report(self._record_for_report, self.summary))
        return Path(path)

    def video(
        self,
        path: str | os.PathLike[str],
        *,
        width: int = 1280,
        height: int = 720,
        fps: float = 30.0,
        speed: float = 1.0,
        span_s: tuple[float, float] = WHOLE_RUN_SPAN_S,
    ) -> Path:
        """Render a video of the run, and write it to a file.

        Args:
            path: The file to write, with the suffix .mp4 or .gif.
            width: Width of the video in pixels.
            height: Height of the video in pixels.
            fps: Frames per second of the video.
            speed: Seconds of robot time in a second of the video.
            span_s: Start and end of the part of the run to render, in s of robot time; the whole run if not given.

        Returns:
            The path of the file.

        Raises:
            ConfigError: The run has no pose, or the extra `report` is not installed.
        """
        from snakesim_operator.playback.video import film_record

        film_record(
            self.record,
            Path(path),
            size=(width, height),
            fps=fps,
            speed=speed,
            span_s=span_s,
            print_text=lambda _line: None,
        )
        return Path(path)

    def compare(self, other: "Result") -> str:
        """Return the differences between this run and another one, as `snakesim study compare` prints them."""
        from snakesim_operator.results.compare.difference import compute_difference
        from snakesim_operator.results.compare.table import format_comparison as format_table

        return "\n".join(format_table(compute_difference(self.record, other.record)))

    def __repr__(self) -> str:
        summary = self.summary
        moved_m = get_distance_m(summary)
        moved = "" if moved_m is None else f", moved {moved_m:.3f} m"
        configuration = f"{summary.scenario}, {summary.controller}, {summary.backend}"
        slow = "".join(f", {part}" for part in summary.too_slow)
        digest = self.digest[:16]
        return f"<Result {configuration}: {summary.duration_s:g} s{moved}, {summary.ended}{slow}, digest {digest}>"

    def _repr_html_(self) -> str:
        from snakesim_operator.results.report import render_playback_page

        return embed_in_iframe(render_playback_page(self.record, self.summary), PLAYBACK_HEIGHT_PX)

    @property
    def _record_for_report(self) -> RunRecord:
        """The run record. If its folder was deleted, a copy from which pages do not link to files in the folder."""
        if self.record.path.exists():
            return self.record
        return dataclasses.replace(self.record, config_path=None)

    def _make_figure(self, name: str) -> dict[str, Any]:
        """Return the figure of a signal over time."""
        if name not in self.signal_names:
            self[name]  # raises ConfigError, unless it is a part of a signal
        unit = find_unit(name, self.record)
        title = name if unit == "1" else f"{name}, {unit}"
        end_s = float(self.time_s[-1]) if len(self.time_s) else 0.0
        return make_line_chart(f"{name} over time", title, self._make_lines(name), end_s)

    def _make_lines(self, name: str) -> Sequence[ChartLine]:
        """Return a line for each column of a signal."""
        columns = select_columns(name, self.columns)
        if list(columns) == [name]:
            return [ChartLine(name, self.time_s, columns[name].astype(float), "--measured")]
        color_count = len(self.joints)
        drawn: list[ChartLine] = []
        for i, (column, values) in enumerate(columns.items()):
            label = column.removeprefix(f"{name}.")
            drawn.append(
                ChartLine(label, self.time_s, values.astype(float), f"--joint-{i % color_count}")
            )
        return drawn
