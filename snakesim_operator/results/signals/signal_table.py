"""Provides all signals of a run by name: as arrays, and split into columns of one value per tick."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.signals.contact_forces import compute_contact_signals
from snakesim_operator.results.signals.motion import compute_motion_signals
from snakesim_operator.results.signals.units import JOINT_SIGNALS

XYZ = ("x", "y", "z")


def compute_signals(record: RunRecord) -> dict[str, NDArray[Any]]:
    """Compute every signal of a run by name, as an array (n,), (n, width), or (n, links or obstacles, 3)."""
    return (
        get_recorded_signals(record)
        | compute_motion_signals(record)
        | compute_contact_signals(record)
        | record.custom_columns
    )


def get_recorded_signals(record: RunRecord) -> dict[str, NDArray[Any]]:
    """Return the arrays of the record itself by name, without signals that are computed from them."""
    signals: dict[str, NDArray[Any]] = {}
    for column in fields(record):  # `vars` would include cached properties
        value = getattr(record, column.name)
        if isinstance(value, np.ndarray):
            signals[column.name] = value
    return signals


def list_component_names(signal: str, record: RunRecord) -> Sequence[str]:
    """List the names of the components of a signal with several values per tick, such as the joints of `angle_rad`."""
    if signal in JOINT_SIGNALS:
        return [joint.name for joint in record.description.joints]
    match signal:
        case "link_force_n":
            return [link.name for link in record.description.links]
        case "link_force_l_n":
            return [f"{link.name}.{axis}" for link in record.description.links for axis in XYZ]
        case "obstacle_force_n":
            return record.contact_log.obstacles
        case "obstacle_force_w_n":
            return [
                f"{obstacle}.{axis}" for obstacle in record.contact_log.obstacles for axis in XYZ
            ]
        case "orientation_wxyz":
            return "wxyz"
        case _:
            return XYZ


def make_signal_columns(record: RunRecord) -> dict[str, NDArray[Any]]:
    """Split every signal of a run into columns (n,), such as `angle_rad.joint_1`, by name."""
    columns: dict[str, NDArray[Any]] = {}
    for name, values in compute_signals(record).items():
        if values.ndim == 1:
            columns[name] = values
            continue
        flat_values = values.reshape(len(values), -1)
        for i, component in enumerate(list_component_names(name, record)):
            columns[f"{name}.{component}"] = flat_values[:, i]
    return columns


def select_columns(name: str, columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Select the columns of a signal or of a part of a signal, such as `angle_rad` or `link_force_l_n.head`."""
    if name in columns:
        return {name: columns[name]}
    return {column: values for column, values in columns.items() if column.startswith(f"{name}.")}
