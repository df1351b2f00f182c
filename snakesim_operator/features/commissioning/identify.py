"""`snakesim identify`: the record of a run of the controller `identify`, judged, printed, drawn, and written down."""

from pathlib import Path
from typing import Any

import numpy as np

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import say
from snakesim_hal.model.files import find
from snakesim_hal.model.textfiles import write_text
from snakesim_hal.wire.messages import Mode
from snakesim_operator.features.commissioning.estimate import Value
from snakesim_operator.features.commissioning.identification import FITS, Identified, identified
from snakesim_operator.features.commissioning.identified_page import page
from snakesim_operator.features.commissioning.measured import by_imus, imus_of, ticks_of
from snakesim_operator.results.record import RunRecord

PAGE = "identified.html"
CONTROLLER = "identify"
COLUMNS = ("angle_rad", "velocity_rad_s", "torque_nm", "target")
SHOWN = {
    "friction_nm": ("dry friction", "N·m"),
    "viscous_nm_s_per_rad": ("viscous friction", "N·m·s/rad"),
    "armature_kg_m2": ("rotor inertia", "kg·m²"),
    "torque_constant_nm_per_a": ("torque constant", "N·m/A"),
    "stiffness_nm_per_rad": ("servo stiffness", "N·m/rad"),
    "damping_nm_s_per_rad": ("servo damping", "N·m·s/rad"),
    "response_time_s": ("response time", "s"),
}


def identify(run: Path, write: Path | None, out: Path | None) -> int:
    """Print every joint, and write page and robot file. Return 0 when all of it was found. Raises ConfigError."""
    if write is not None and find(str(write), "robots") != write:
        raise ConfigError(f"{write}: give the path of your own robot file, such as ./{write}.toml; shipped ones stay")
    record = RunRecord.load(run)
    judged = _judged_ticks(record)
    columns: dict[str, Any] = {name: getattr(record, name)[judged] for name in COLUMNS}
    rates, _ = by_imus(imus_of(record), ticks_of(record), len(record.description.links))
    found = identified(record.config, columns, rates[judged])
    for one in found:
        _print(one)
    if np.isnan(rates).all():
        say("not judged: whether the links follow their encoders; backlash shows only where links have IMUs")
    path = out or (run if run.is_dir() else run.parent) / PAGE
    write_text(path, page(record, found))
    say(f"page: {path}")
    if write is not None:
        _write(write, record, found)
    return 0 if all(one.complete and not one.fails for one in found) else 1


def _judged_ticks(record: RunRecord) -> slice:
    """Return the part in which every value is known and every joint in position mode. Raises ConfigError."""
    if record.config.controller != CONTROLLER:
        raise ConfigError(
            f"{record.folder}: its controller was {record.config.controller!r}; hang the robot by its tail, and make a "
            f"run with `snakesim run identify`"
        )
    columns = [getattr(record, name) for name in COLUMNS]
    known = np.logical_and.reduce([np.isfinite(values).all(axis=1) for values in columns])
    known &= (record.mode == Mode.POSITION).all(axis=1)
    known[1:] &= np.abs(np.diff(record.time_s) * record.config.rate_hz - 1) < 0.5
    edges = np.flatnonzero(np.diff(np.concatenate(([False], known, [False])).astype(int)))
    parts = list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
    if not parts:
        raise ConfigError(f"{record.folder}: the joints were never moved by position targets; run it again")
    start, end = max(parts, key=lambda part: part[1] - part[0])
    return slice(start, end)


def _print(one: Identified) -> None:
    say(f"{one.joint}{'' if one.fits is None else f'   {100 * one.fits:.1f} % of its torque explained'}")
    for field, value in one.fields.items():
        name, unit = SHOWN[field]
        say(f"  {name:<17} {_interval(value)} {unit}")
    if one.latency_s is not None:
        say(f"  {'latency':<17} {_interval(one.latency_s)} s")
    if one.bandwidth_hz is not None:
        say(f"  {'servo bandwidth':<17} {one.bandwidth_hz:.3g} Hz, of this joint with what it carries")
    for why in one.unknown:
        say(f"  unknown: {why}")
    if one.fits is not None and one.fits < FITS:
        say("  it does not move as a robot that hangs by its tail: look at clamp, masses, lengths and backlash")


def _interval(value: Value) -> str:
    return f"{value.value:.4g}, {value.value - value.within:.4g} to {value.value + value.within:.4g}"


def _write(path: Path, record: RunRecord, found: list[Identified]) -> None:
    from snakesim_operator.features.commissioning.robot_edit import change_joints

    values: dict[str, dict[str, Any]] = {}
    for one in found:
        if one.fields and not one.fails:
            values[one.joint] = {field: max(value.value, 0.0) for field, value in one.fields.items()}
    left = [one.joint for one in found if one.joint not in values]
    if not values:
        say(f"{path}: nothing was written: the values of no joint are sure")
        return
    change_joints(path, values, f"identified from {record.folder.name}")
    say(f"{path}: {len(values)} joints changed; restart the host with it")
    if left:
        say(f"{path}: left as they were: {', '.join(left)}")
