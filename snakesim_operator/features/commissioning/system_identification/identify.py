"""`snakesim robot identify`: identifies the joints from a run of the controller `identify`."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import print_json, print_line
from snakesim_hal.model.files import resolve_file_path
from snakesim_hal.model.plugins import BACKENDS, load_plugin_unless_file
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.textfiles import write_text
from snakesim_hal.wire.messages import Imu, JointMode
from snakesim_operator.features.commissioning.joint_check.measurements import (
    arrange_imus_by_tick,
    compute_tick_numbers,
    read_imus,
)
from snakesim_operator.features.commissioning.system_identification.identification import (
    MIN_EXPLAINED,
    JointIdentification,
    identify_joints,
)
from snakesim_operator.features.commissioning.system_identification.identified_page import (
    render_identification_page,
)
from snakesim_operator.features.commissioning.system_identification.least_squares import (
    IntervalEstimate,
)
from snakesim_operator.results.run_log import RunRecord

PAGE_FILENAME = "identified.html"
CONTROLLER = "identify"
TORQUE_CONSTANT = "torque_constant_nm_per_a"
SIGNAL_NAMES = ("angle_rad", "velocity_rad_s", "torque_nm", "target")
COLUMN_NAMES = (*SIGNAL_NAMES, "mode", "time_s")  # that an identification needs
LABEL_AND_UNIT_BY_FIELD = {  # fields of the robot file -> name and unit
    "friction_nm": ("dry friction", "N·m"),
    "viscous_nm_s_per_rad": ("viscous friction", "N·m·s/rad"),
    "armature_kg_m2": ("rotor inertia", "kg·m²"),
    TORQUE_CONSTANT: ("torque constant", "N·m/A"),
    "stiffness_nm_per_rad": ("servo stiffness", "N·m/rad"),
    "damping_nm_s_per_rad": ("servo damping", "N·m·s/rad"),
    "response_time_s": ("response time", "s"),
    "latency_s": ("latency", "s"),
}


@dataclass(frozen=True)
class RunIdentification:
    """What was identified of the joints from one run."""

    joints: list[JointIdentification]  # tail to head
    judges_links: bool  # whether links have IMUs, which show backlash


def identify_and_report(
    run: Path, robot_file: Path | None, output_path: Path | None, *, as_json: bool = False
) -> int:
    """Identify the joints from a run, print the values, and write them to an HTML page and into the robot file.

    Args:
        run: Path of the run folder, or of its recording.
        robot_file: The user's robot file to write the values into; None if no robot file is to be written.
        output_path: Path of the page; None for a file in the folder of the run.
        as_json: Whether to print one JSON object instead of text.

    Returns:
        The exit code: 0 if every value of every joint was identified, otherwise 1.

    Raises:
        ConfigError: The run is of another controller, or a file cannot be read or written.
    """
    if robot_file is not None and resolve_file_path(str(robot_file), "robots") != robot_file:
        raise ConfigError(
            f"{robot_file}: give the path of your own robot file, such as ./{robot_file}.toml; shipped ones stay",
            code="commissioning/not-possible",
        )
    record = RunRecord.load(run)
    columns: dict[str, Any] = {name: getattr(record, name) for name in COLUMN_NAMES}
    identification = identify_run(record.config, columns, read_imus(record), str(record.path))
    results = identification.joints
    run_folder = run if run.is_dir() else run.parent
    page_path = output_path or run_folder / PAGE_FILENAME
    write_text(page_path, render_identification_page(record, results))
    if as_json:
        print_json({"joints": results, "page": str(page_path)})
    else:
        _print_joints(results, judges_links=identification.judges_links)
        print_line(f"page: {page_path}")
    if robot_file is not None:
        _write_robot_file(robot_file, record, results)
    everything_identified = all(result.complete and not result.fails for result in results)
    return 0 if everything_identified else 1


def identify_run(
    config: RunConfig, columns: Mapping[str, Floats], imus: Iterable[Imu], run_name: str
) -> RunIdentification:
    """Identify the joints from the measurements of a whole run.

    Args:
        config: Configuration of the run.
        columns: Recorded signals by name, those of COLUMN_NAMES, with one row for each tick.
        imus: Every IMU message of the run.
        run_name: Name of the run in error messages.

    Raises:
        ConfigError: The run is of another controller, or the joints never followed position targets.
    """
    usable_ticks = _find_usable_ticks(config, columns, run_name)
    ticks = compute_tick_numbers(columns["time_s"], config.rate_hz)
    link_count = len(config.robot.joint_table) + 1
    link_rates, _ = arrange_imus_by_tick(imus, ticks, link_count)
    usable_columns = {name: columns[name][usable_ticks] for name in SIGNAL_NAMES}
    joints = identify_joints(config, usable_columns, link_rates[usable_ticks])
    return RunIdentification(joints, judges_links=not np.isnan(link_rates).all())


def _find_usable_ticks(config: RunConfig, columns: Mapping[str, Floats], run_name: str) -> slice:
    """Find the longest part of a run in which the joints can be identified.

    In that part every value is known, all joints are in position mode, and no tick is missing.

    Returns:
        The slice of the run log's rows, one row for each tick.

    Raises:
        ConfigError: The run is of another controller, or has no such part.
    """
    if config.controller != CONTROLLER:
        raise ConfigError(
            f"{run_name}: its controller was {config.controller!r}; hang the robot by its tail, and make a "
            f"run with `snakesim run identify`",
            code="commissioning/not-possible",
        )
    signals = [columns[name] for name in SIGNAL_NAMES]
    is_usable = np.logical_and.reduce([np.isfinite(values).all(axis=1) for values in signals])
    is_usable &= (columns["mode"] == JointMode.POSITION).all(axis=1)
    ticks_since_last_row = np.diff(columns["time_s"]) * config.rate_hz
    is_usable[1:] &= np.abs(ticks_since_last_row - 1) < 0.5
    padded_is_usable = np.concatenate(([False], is_usable, [False])).astype(int)
    edges = np.flatnonzero(np.diff(padded_is_usable))
    usable_parts = list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
    if not usable_parts:
        raise ConfigError(
            f"{run_name}: the joints were never moved by position targets; run it again",
            code="commissioning/not-possible",
        )
    start, end = max(usable_parts, key=lambda usable_part: usable_part[1] - usable_part[0])
    return slice(start, end)


def _print_joints(results: Sequence[JointIdentification], *, judges_links: bool) -> None:
    """Print what was identified of each joint. `judges_links` is whether links have IMUs, which show backlash."""
    for result in results:
        _print_joint(result)
    if not judges_links:
        print_line(
            "not judged: whether the links follow their encoders; backlash shows only where links have IMUs"
        )


def _print_joint(result: JointIdentification) -> None:
    if result.explained is None:
        print_line(result.joint)
    else:
        print_line(f"{result.joint}   {100 * result.explained:.1f} % of its torque explained")
    for field, estimate in result.fields.items():
        name, unit = LABEL_AND_UNIT_BY_FIELD[field]
        print_line(f"  {name:<17} {_format_interval(estimate)} {unit}")
    if result.bandwidth_hz is not None:
        print_line(
            f"  {'servo bandwidth':<17} {result.bandwidth_hz:.3g} Hz, of this joint with what it carries"
        )
    for reason in result.wrong:
        print_line(f"  wrong: {reason}")
    for reason in result.unknown:
        print_line(f"  unknown: {reason}")
    if result.explained is not None and result.explained < MIN_EXPLAINED:
        print_line(
            "  it does not move as a robot that hangs by its tail: look at clamp, masses, lengths and backlash"
        )


def _format_interval(estimate: IntervalEstimate) -> str:
    low = estimate.value - estimate.half_width
    high = estimate.value + estimate.half_width
    return f"{estimate.value:.4g}, {low:.4g} to {high:.4g}"


def _write_robot_file(
    path: Path, record: RunRecord, results: Sequence[JointIdentification]
) -> None:
    """Write the values of the joints that do not fail into a robot file, and print what was written.

    A torque constant is written only if the driver uses it. The drives of other types compute the torque themselves, so
    that a new value in the file would not change the torque, and would hide the wrong value in the drive.
    """
    from snakesim_operator.features.commissioning.robot_edit import write_joint_fields

    joints_that_use_constant = {
        joint.name
        for joint in record.config.robot.joint_table
        if _uses_torque_constant(record.config, joint)
    }
    values: dict[str, dict[str, Any]] = {}
    joints_with_old_constant: list[str] = []
    for result in results:
        if not result.fields or result.fails:
            continue
        estimates = dict(result.fields)
        if TORQUE_CONSTANT in estimates and result.joint not in joints_that_use_constant:
            del estimates[TORQUE_CONSTANT]
            joints_with_old_constant.append(result.joint)
        # An estimate of a small friction or latency may be below zero, which no robot file may hold.
        values[result.joint] = {
            field: max(estimate.value, 0.0) for field, estimate in estimates.items()
        }
    unchanged = [result.joint for result in results if result.joint not in values]
    if not values:
        print_line(f"{path}: nothing was written: the values of no joint are sure")
        return
    write_joint_fields(path, values, f"identified from {record.path.name}")
    print_line(f"{path}: {len(values)} joints changed; restart the host with it")
    if joints_with_old_constant:
        print_line(
            f"{path}: `{TORQUE_CONSTANT}` of {', '.join(joints_with_old_constant)} was left as it was, because their "
            f"drivers are not known to use it: if it is wrong, correct it in the drives"
        )
    if unchanged:
        print_line(f"{path}: left as they were: {', '.join(unchanged)}")


def _uses_torque_constant(config: RunConfig, joint: Joint) -> bool:
    """Return whether the driver of a joint surely uses the torque constant in the robot file.

    The code of a driver in a file is not run, because a recording may come from an unknown user. Such a driver counts
    as one that does not use the constant, and so does one that is not installed here.
    """
    driver = joint.drive.driver if config.backend == "mixed" else config.backend
    try:
        driver_type = load_plugin_unless_file(BACKENDS, driver)
    except ConfigError:
        return False
    return getattr(driver_type, "uses_torque_constant", False)
