"""What was measured against what the values that were found say, joint by joint: a page that needs no other file."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from snakesim_operator.features.commissioning.estimate import HALF, Value
from snakesim_operator.features.commissioning.identification import Identified
from snakesim_operator.results.page.charts import Figure, Line, lines
from snakesim_operator.results.page.html import render, shown
from snakesim_operator.results.record import RunRecord

MEASURED, FOUND = "--measured", "--reference"


def page(record: RunRecord, found: Sequence[Identified]) -> str:
    """The whole page."""
    period_s = record.config.period_ns * 1e-9
    return render(
        Path(__file__).parent / "identified.html",
        len(found),
        title=f"Joints of {record.config.robot.name}, identified from {record.folder.name}",
        emulated=record.description.emulated,
        backend=record.description.backend,
        fields=list(dict.fromkeys(field for one in found for field in one.fields)),
        found=[(one, _figures(one, period_s)) for one in reversed(found)],
        interval=_interval,
    )


def _figures(one: Identified, period_s: float) -> list[Figure]:
    if one.servo is None or one.friction is None:
        return []
    made: list[Figure] = []
    measured, by_balance = one.friction.torque_nm.T
    count = min(len(one.servo.torque_nm) - 2 * HALF, len(measured))
    time_s = (np.arange(count, dtype=np.float64) + HALF) * np.float64(period_s)
    by_servo = one.servo.torque_nm[HALF : HALF + count]
    for words, values in (("links and friction", by_balance[:count]), ("target, servo and lag", by_servo)):
        drawn = [
            Line("measured", time_s, measured[:count], MEASURED, width=3.0),
            Line(f"by {words}", time_s, values, FOUND),
        ]
        made.append(lines(f"Torque of {one.joint}, measured and by {words}", "torque, N·m", drawn, float(time_s[-1])))
    return made


def _interval(value: Value | None) -> str:
    return "–" if value is None else f"{shown(value.value, 4)} ± {shown(value.within, 2)}"
