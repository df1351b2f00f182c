"""Files with the signals of start check trials, so that a changed judgment needs no second simulation.

The results file `trials.jsonl` has the folder `trials.signals` next to it, with one compressed file for each robot. It
holds exactly what the judgment reads, `CheckMeasurements`, without a rounding error.
"""

from dataclasses import fields
from pathlib import Path

import msgspec
import numpy as np

from snakesim_hal.model.robot_file.joints import JointDrive, JointMotor
from snakesim_operator.features.commissioning.joint_check.measurements import CheckMeasurements

HEADER = "header"  # name of the array with the JSON of everything that is not an array


class SignalHeader(msgspec.Struct, frozen=True, kw_only=True):
    """The part of `CheckMeasurements` that does not consist of arrays."""

    period_s: float
    joint_names: list[str]
    axes: list[str]
    drives: list[JointDrive]
    motors: list[JointMotor]
    link_lengths_m: list[float]
    link_masses_kg: list[float]


ARRAY_NAMES = [
    field.name
    for field in fields(CheckMeasurements)
    if field.name not in SignalHeader.__struct_fields__
]


def find_signals_path(results_path: Path, backend: str, number: int) -> Path:
    """Return the path of the signals of one robot of a results file."""
    return results_path.with_suffix(".signals") / f"{backend}-{number}.npz"


def save_signals(path: Path, measurements: CheckMeasurements) -> None:
    """Write the measurements of a robot into a compressed file, and make its folder if it is missing."""
    header = SignalHeader(
        period_s=measurements.period_s,
        joint_names=list(measurements.joint_names),
        axes=list(measurements.axes),
        drives=list(measurements.drives),
        motors=list(measurements.motors),
        link_lengths_m=list(measurements.link_lengths_m),
        link_masses_kg=list(measurements.link_masses_kg),
    )
    arrays = {name: getattr(measurements, name) for name in ARRAY_NAMES}
    arrays[HEADER] = np.frombuffer(msgspec.json.encode(header), dtype=np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays)


def load_signals(path: Path) -> CheckMeasurements:
    """Read the measurements of a robot. Raises FileNotFoundError."""
    with np.load(path) as arrays:
        header = msgspec.json.decode(arrays[HEADER].tobytes(), type=SignalHeader)
        return CheckMeasurements(
            period_s=header.period_s,
            joint_names=header.joint_names,
            axes=header.axes,
            drives=header.drives,
            motors=header.motors,
            link_lengths_m=header.link_lengths_m,
            link_masses_kg=header.link_masses_kg,
            **{name: arrays[name] for name in ARRAY_NAMES},
        )
