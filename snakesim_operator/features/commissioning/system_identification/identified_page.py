"""The page of a system identification: for each joint, the measured torque and the torque of the identified models."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from snakesim_operator.features.commissioning.system_identification.identification import (
    JointIdentification,
)
from snakesim_operator.features.commissioning.system_identification.least_squares import (
    IntervalEstimate,
)
from snakesim_operator.features.commissioning.system_identification.smoothing import (
    HALF_WINDOW_TICKS,
)
from snakesim_operator.results.page.charts import ChartLine, PlotlyDict, make_line_chart
from snakesim_operator.results.page.html import format_number, render_page
from snakesim_operator.results.run_log import RunRecord

MEASURED_COLOR = "--measured"
MODEL_COLOR = "--reference"


def render_identification_page(record: RunRecord, rows: Sequence[JointIdentification]) -> str:
    """Return the whole page as HTML, which needs no other file."""
    period_s = record.config.period_ns * 1e-9
    field_names = [field for row in rows for field in row.fields]
    return render_page(
        Path(__file__).parent / "identified.html",
        len(rows),
        title=f"Joints of {record.config.robot.name}, identified from {record.path.name}",
        emulated=record.description.emulated,
        backend=record.description.backend,
        fields=list(dict.fromkeys(field_names)),
        rows=[(row, _draw_torques(row, period_s)) for row in reversed(rows)],
        interval=_format_interval,
    )


def _draw_torques(result: JointIdentification, period_s: float) -> list[PlotlyDict]:
    """Draw the measured torque of a joint over time, once with each of the two torques that its models compute.

    Args:
        result: Identified values of the joint, and its models.
        period_s: Period of a tick.

    Returns:
        Two Plotly figures in N·m; no figure if one of the models could not be fitted.
    """
    if result.servo is None or result.balance is None:
        return []
    measured_nm, balance_nm = result.balance.torque_nm.T
    # The smoothed signals of the balance begin and end half a window inside the record.
    tick_count = min(len(result.servo.torque_nm) - 2 * HALF_WINDOW_TICKS, len(measured_nm))
    time_s = (np.arange(tick_count, dtype=np.float64) + HALF_WINDOW_TICKS) * np.float64(period_s)
    servo_nm = result.servo.torque_nm[HALF_WINDOW_TICKS : HALF_WINDOW_TICKS + tick_count]
    torque_by_model = {
        "links and friction": balance_nm[:tick_count],
        "target, servo and lag": servo_nm,
    }
    figures: list[PlotlyDict] = []
    for model, model_nm in torque_by_model.items():
        curves = [
            ChartLine("measured", time_s, measured_nm[:tick_count], MEASURED_COLOR, width=3.0),
            ChartLine(f"by {model}", time_s, model_nm, MODEL_COLOR),
        ]
        title = f"Torque of {result.joint}, measured and by {model}"
        figures.append(make_line_chart(title, "torque, N·m", curves, float(time_s[-1])))
    return figures


def _format_interval(estimate: IntervalEstimate | None) -> str:
    if estimate is None:
        return "–"
    return f"{format_number(estimate.value, 4)} ± {format_number(estimate.half_width, 2)}"
