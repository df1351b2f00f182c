"""`snakesim robot identify`: identifies the joints from a run of the controller `identify`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import print_json, print_line
from snakesim_hal.model.files import find_file
from snakesim_hal.model.textfiles import write_text
from snakesim_hal.wire.messages import Mode
from snakesim_operator.features.commissioning.identification import (
    MIN_EXPLAINED,
    JointIdentification,
    identify_joints,
)
from snakesim_operator.features.commissioning.identified_page import render_page
from snakesim_operator.features.commissioning.least_squares import Estimate
from snakesim_operator.features.commissioning.measured import arrange_by_tick, read_imus, tick_numbers
from snakesim_operator.results.run_log import RunRecord

PAGE = "identified.html"
CONTROLLER = "identify"
COLUMNS = ("angle_rad", "velocity_rad_s", "torque_nm", "target")
LABELS = {  # fields of the robot file -> name and unit
    "friction_nm": ("dry friction", "N·m"),
    "viscous_nm_s_per_rad": ("viscous friction", "N·m·s/rad"),
    "armature_kg_m2": ("rotor inertia", "kg·m²"),
    "torque_constant_nm_per_a": ("torque constant", "N·m/A"),
    "stiffness_nm_per_rad": ("servo stiffness", "N·m/rad"),
    "damping_nm_s_per_rad": ("servo damping", "N·m·s/rad"),
    "response_time_s": ("response time", "s"),
}


def identify(run: Path, robot_file: Path | None, out: Path | None, *, as_json: bool = False) -> int:
    """Identify the joints of a run, print them, and write a page.

    Args:
        run: folder of the run, or its recording.
        robot_file: the user's robot file to write the values into; None: no robot file is written.
        out: the page; None: a file in the folder of the run.
        as_json: whether to print one JSON object instead of text.

    Returns:
        0 if every value of every joint was identified, otherwise 1.

    Raises:
        ConfigError: the run is of another controller, or a file cannot be read or written.
    """
    if robot_file is not None and find_file(str(robot_file), "robots") != robot_file:
        raise ConfigError(
            f"{robot_file}: give the path of your own robot file, such as ./{robot_file}.toml; shipped ones stay",
            code="commissioning/not-possible",
        )
    record = RunRecord.load(run)
    judged_ticks = _find_judged_ticks(record)
    columns: dict[str, Any] = {name: getattr(record, name)[judged_ticks] for name in COLUMNS}
    link_rates, _ = arrange_by_tick(read_imus(record), tick_numbers(record), len(record.description.links))
    rows = identify_joints(record.config, columns, link_rates[judged_ticks])
    run_folder = run if run.is_dir() else run.parent
    page_path = out or run_folder / PAGE
    write_text(page_path, render_page(record, rows))
    if as_json:
        print_json({"joints": rows, "page": str(page_path)})
    else:
        _print_joints(rows, judges_links=not np.isnan(link_rates).all())
        print_line(f"page: {page_path}")
    if robot_file is not None:
        _write_robot_file(robot_file, record, rows)
    everything_identified = all(row.complete and not row.fails for row in rows)
    return 0 if everything_identified else 1


def _find_judged_ticks(record: RunRecord) -> slice:
    """Return the rows of the longest part of a run in which the joints can be identified.

    In that part every value is known, all joints are in position mode, and no tick is missing.

    Raises:
        ConfigError: The run is of another controller, or has no such part.
    """
    if record.config.controller != CONTROLLER:
        raise ConfigError(
            f"{record.folder}: its controller was {record.config.controller!r}; hang the robot by its tail, and make a "
            f"run with `snakesim run identify`",
            code="commissioning/not-possible",
        )
    columns = [getattr(record, name) for name in COLUMNS]
    usable = np.logical_and.reduce([np.isfinite(values).all(axis=1) for values in columns])
    usable &= (record.mode == Mode.POSITION).all(axis=1)
    ticks_since_last_row = np.diff(record.time_s) * record.config.rate_hz
    usable[1:] &= np.abs(ticks_since_last_row - 1) < 0.5
    padded = np.concatenate(([False], usable, [False])).astype(int)
    edges = np.flatnonzero(np.diff(padded))
    parts = list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
    if not parts:
        raise ConfigError(
            f"{record.folder}: the joints were never moved by position targets; run it again",
            code="commissioning/not-possible",
        )
    start, end = max(parts, key=lambda part: part[1] - part[0])
    return slice(start, end)


def _print_joints(rows: Sequence[JointIdentification], *, judges_links: bool) -> None:
    """Print what is known of each joint. judges_links: whether links have IMUs, which show backlash."""
    for row in rows:
        _print_joint(row)
    if not judges_links:
        print_line("not judged: whether the links follow their encoders; backlash shows only where links have IMUs")


def _print_joint(row: JointIdentification) -> None:
    if row.explained is None:
        print_line(row.joint)
    else:
        print_line(f"{row.joint}   {100 * row.explained:.1f} % of its torque explained")
    for field, estimate in row.fields.items():
        name, unit = LABELS[field]
        print_line(f"  {name:<17} {_format_interval(estimate)} {unit}")
    if row.latency_s is not None:
        print_line(f"  {'latency':<17} {_format_interval(row.latency_s)} s")
    if row.bandwidth_hz is not None:
        print_line(f"  {'servo bandwidth':<17} {row.bandwidth_hz:.3g} Hz, of this joint with what it carries")
    for reason in row.unknown:
        print_line(f"  unknown: {reason}")
    if row.explained is not None and row.explained < MIN_EXPLAINED:
        print_line("  it does not move as a robot that hangs by its tail: look at clamp, masses, lengths and backlash")


def _format_interval(estimate: Estimate) -> str:
    low = estimate.value - estimate.half_width
    high = estimate.value + estimate.half_width
    return f"{estimate.value:.4g}, {low:.4g} to {high:.4g}"


def _write_robot_file(path: Path, record: RunRecord, rows: Sequence[JointIdentification]) -> None:
    """Write the values of the joints that do not fail into a robot file, and print what was written."""
    from snakesim_operator.features.commissioning.robot_edit import change_joints

    values: dict[str, dict[str, Any]] = {}
    for row in rows:
        if row.fields and not row.fails:
            # An estimate of a small friction may be below zero, which no robot file may hold.
            values[row.joint] = {field: max(estimate.value, 0.0) for field, estimate in row.fields.items()}
    unchanged = [row.joint for row in rows if row.joint not in values]
    if not values:
        print_line(f"{path}: nothing was written: the values of no joint are sure")
        return
    change_joints(path, values, f"identified from {record.folder.name}")
    print_line(f"{path}: {len(values)} joints changed; restart the host with it")
    if unchanged:
        print_line(f"{path}: left as they were: {', '.join(unchanged)}")
