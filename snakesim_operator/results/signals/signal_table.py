"""All signals of a run by name: as arrays, and split into columns of numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.signals.contact_forces import find_contact_signals
from snakesim_operator.results.signals.motion import find_motion_signals
from snakesim_operator.results.signals.units import OF_JOINTS

XYZ = ("x", "y", "z")


def arrays(record: RunRecord) -> dict[str, NDArray[Any]]:
    """Return every signal as an array, (n,), (n, width), or (n, links or obstacles, 3)."""
    return recorded_arrays(record) | find_motion_signals(record) | find_contact_signals(record) | record.custom


def recorded_arrays(record: RunRecord) -> dict[str, NDArray[Any]]:
    """Return the arrays of the record itself, without what follows from them."""
    signals: dict[str, NDArray[Any]] = {}
    for column in fields(record):  # `vars` would include what the record has computed and cached
        value = getattr(record, column.name)
        if isinstance(value, np.ndarray):
            signals[column.name] = value
    return signals


def name_parts(signal: str, record: RunRecord) -> Sequence[str]:
    """Return the names of the parts of a signal that is wider than one, such as the joints of `angle_rad`."""
    if signal in OF_JOINTS:
        return [joint.name for joint in record.description.joints]
    match signal:
        case "link_force_n":
            return [link.name for link in record.description.links]
        case "link_force_l_n":
            return [f"{link.name}.{axis}" for link in record.description.links for axis in XYZ]
        case "obstacle_force_n":
            return record.contact_log.obstacles
        case "obstacle_force_w_n":
            return [f"{obstacle}.{axis}" for obstacle in record.contact_log.obstacles for axis in XYZ]
        case "orientation_wxyz":
            return "wxyz"
        case _:
            return XYZ


def table(record: RunRecord) -> dict[str, NDArray[Any]]:
    """Return every column as numbers, (n,)."""
    columns: dict[str, NDArray[Any]] = {}
    for name, values in arrays(record).items():
        if values.ndim == 1:
            columns[name] = values
            continue
        flat = values.reshape(len(values), -1)
        for i, part in enumerate(name_parts(name, record)):
            columns[f"{name}.{part}"] = flat[:, i]
    return columns


def select_columns(name: str, columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the columns of a signal or of a part of it, such as `angle_rad` or `link_force_l_n.head`."""
    if name in columns:
        return {name: columns[name]}
    return {column: values for column, values in columns.items() if column.startswith(f"{name}.")}
