"""The page of a system identification: for each joint, the measured torque and the torque of the identified models."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from snakesim_operator.features.commissioning.identification import JointIdentification
from snakesim_operator.features.commissioning.least_squares import Estimate
from snakesim_operator.features.commissioning.smoothing import HALF_WINDOW
from snakesim_operator.results.page.charts import Figure, Line, lines
from snakesim_operator.results.page.html import render, shown
from snakesim_operator.results.run_log import RunRecord

MEASURED_COLOR = "--measured"
MODEL_COLOR = "--reference"


def render_page(record: RunRecord, rows: Sequence[JointIdentification]) -> str:
    """Return the whole page as HTML, which needs no other file."""
    period_s = record.config.period_ns * 1e-9
    field_names = [field for row in rows for field in row.fields]
    return render(
        Path(__file__).parent / "identified.html",
        len(rows),
        title=f"Joints of {record.config.robot.name}, identified from {record.folder.name}",
        emulated=record.description.emulated,
        backend=record.description.backend,
        fields=list(dict.fromkeys(field_names)),
        rows=[(row, _draw_torques(row, period_s)) for row in reversed(rows)],
        interval=_format_interval,
    )


def _draw_torques(row: JointIdentification, period_s: float) -> list[Figure]:
    """Return one figure for each of the two models of a joint, with the measured torque and that of the model in N·m.

    Args:
        row: What was identified of the joint; without both models there is no figure.
        period_s: Period of a tick.
    """
    if row.servo is None or row.balance is None:
        return []
    measured, by_balance = row.balance.torque_nm.T
    count = min(len(row.servo.torque_nm) - 2 * HALF_WINDOW, len(measured))
    time_s = (np.arange(count, dtype=np.float64) + HALF_WINDOW) * np.float64(period_s)
    by_servo = row.servo.torque_nm[HALF_WINDOW : HALF_WINDOW + count]
    models = {"links and friction": by_balance[:count], "target, servo and lag": by_servo}
    figures: list[Figure] = []
    for model, torque in models.items():
        curves = [
            Line("measured", time_s, measured[:count], MEASURED_COLOR, width=3.0),
            Line(f"by {model}", time_s, torque, MODEL_COLOR),
        ]
        title = f"Torque of {row.joint}, measured and by {model}"
        figures.append(lines(title, "torque, N·m", curves, float(time_s[-1])))
    return figures


def _format_interval(estimate: Estimate | None) -> str:
    if estimate is None:
        return "–"
    return f"{shown(estimate.value, 4)} ± {shown(estimate.half_width, 2)}"
