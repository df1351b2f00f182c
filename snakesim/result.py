"""What came of a run: signals by name with their units, metrics, and pages, plots and films of them."""

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

from snakesim.chart import Chart, framed
from snakesim_hal.base.errors import ConfigError, did_you_mean, short
from snakesim_hal.model.textfiles import write_text
from snakesim_operator.playback.export import OF_JOINTS, arrays, table, unit_of
from snakesim_operator.results.page.charts import Line, lines
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.run_ending import COMPLETE
from snakesim_operator.results.summary import RunSummary, distance_m

PLAYBACK_PX = 580
SPAN_S = (0.0, math.inf)


@dataclasses.dataclass(frozen=True, eq=False)
class Result:
    """A run that is over. Every signal has a row for each tick since the first arming; NaN is unknown.

    result["angle_rad"] is (ticks, joints), result["angle_rad.joint_3"] is (ticks,); `names` lists all.
    """

    record: RunRecord
    summary: RunSummary

    @cached_property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """Every signal, (ticks,) or (ticks, width)."""
        return arrays(self.record)

    @cached_property
    def columns(self) -> dict[str, NDArray[Any]]:
        """Every signal one number wide, (ticks,), as in the tables of `snakesim export`."""
        return table(self.record)

    @property
    def names(self) -> list[str]:
        """Of all signals."""
        return list(self.arrays | self.columns)

    @cached_property
    def units(self) -> dict[str, str]:
        """Of each signal, SI; "1" for plain numbers."""
        return {name: unit_of(name, self.record) for name in self.names}

    @property
    def joints(self) -> list[str]:
        """Names of the joints, tail to head: the second axis of `angle_rad` and the like."""
        return [joint.name for joint in self.record.description.joints]

    @property
    def time_s(self) -> NDArray[np.float64]:
        """Robot time of each row."""
        return self.record.time_s

    @cached_property
    def metrics(self) -> dict[str, float | bool | None]:
        """The numbers of the summary; units are in the names; None is unknown."""
        of = msgspec.structs.asdict(self.summary)
        return {name: value for name, value in of.items() if value is None or isinstance(value, bool | int | float)}

    @property
    def digest(self) -> str:
        """Hash of every setpoint as applied: the same for the same run, to the bit."""
        return self.summary.command_digest

    @property
    def ended(self) -> str:
        """How the run ended: "complete", or what failed."""
        return self.summary.ended

    @property
    def complete(self) -> bool:
        """Whether the robot was armed for all of the time asked for."""
        return self.ended == COMPLETE

    def __getitem__(self, name: str) -> NDArray[Any]:
        """A signal. Raises ConfigError, for a name that there is not."""
        if name not in self.names:
            raise ConfigError(
                f"no signal {short(str(name))!r}; {did_you_mean(str(name), self.names)}there are "
                f"{', '.join(self.arrays)}, and columns of them such as angle_rad.{self.joints[0]}: see `names`"
            )
        return self.arrays[name] if name in self.arrays else self.columns[name]

    def to_pandas(self) -> Any:
        """A DataFrame of all columns, with the time as its index; `attrs["units"]` has the units.

        Raises ConfigError without pandas.
        """
        try:
            pandas = importlib.import_module("pandas")
        except ImportError as error:
            raise ConfigError(
                f"to_pandas() needs pandas ({error}); install it with: {sys.executable} -m pip install pandas"
            ) from None
        frame = pandas.DataFrame(self.columns).set_index("time_s")
        frame.attrs["units"] = {name: self.units[name] for name in frame.columns}
        return frame

    def plot(self, *signals: str) -> Chart:
        """A chart for each signal over time; without names, of angles and torques. Raises ConfigError."""
        figures = [self._figure(name) for name in signals or ("angle_rad", "torque_nm")]
        return Chart(self.summary.scenario, figures, len(self.joints))

    def report(self, path: str | os.PathLike[str]) -> Path:
        """Write the run's report: one page of HTML, which needs no network and no other file."""
        from snakesim_operator.results.report import page

        write_text(Path(path), page(self._unkept, self.summary))
        return Path(path)

    def video(
        self,
        path: str | os.PathLike[str],
        *,
        width: int = 1280,
        height: int = 720,
        fps: float = 30.0,
        speed: float = 1.0,
        span_s: tuple[float, float] = SPAN_S,
    ) -> Path:
        """Film the run into FILE.mp4 or FILE.gif. Raises ConfigError without a pose, or the extra `video`."""
        from snakesim_operator.playback.video import film

        film(self.record, Path(path), size=(width, height), fps=fps, speed=speed, span_s=span_s, say=lambda _line: None)
        return Path(path)

    def compare(self, other: "Result") -> str:
        """What differs between this run and another one, as `snakesim compare` prints it."""
        from snakesim_operator.results.compare.difference import differ
        from snakesim_operator.results.compare.table import table as in_words

        return "\n".join(in_words(differ(self.record, other.record)))

    def __repr__(self) -> str:
        of, moved_m = self.summary, distance_m(self.summary)
        moved = "" if moved_m is None else f", moved {moved_m:.3f} m"
        what = f"{of.scenario}, {of.controller}, {of.backend}"
        slow = "".join(f", {words}" for words in of.too_slow)
        return f"<Result {what}: {of.duration_s:g} s{moved}, {of.ended}{slow}, digest {self.digest[:16]}>"

    def _repr_html_(self) -> str:
        from snakesim_operator.results.report import playback_page

        return framed(playback_page(self.record, self.summary), PLAYBACK_PX)

    @property
    def _unkept(self) -> RunRecord:
        """The record, whose folder may be gone: its pages then name no files in it."""
        return self.record if self.record.folder.exists() else dataclasses.replace(self.record, alone=True)

    def _figure(self, name: str) -> dict[str, Any]:
        values, unit = self[name].astype(float), self.units[name]
        drawn = self._drawn(name, values)
        until_s = float(self.time_s[-1]) if len(self.time_s) else 0.0
        return lines(f"{name} over time", name if unit == "1" else f"{name}, {unit}", drawn, until_s)

    def _drawn(self, name: str, values: NDArray[np.float64]) -> Sequence[Line]:
        if values.ndim == 1:
            return [Line(name, self.time_s, values, "--measured")]
        parts = self.joints if name in OF_JOINTS else "xyz" if name == "position_w" else "wxyz"
        return [Line(part, self.time_s, values[:, i], f"--joint-{i}") for i, part in enumerate(parts)]
