"""Defines the names and units of signals."""

from snakesim_hal.model.fields.field_words import find_unit_in_name
from snakesim_hal.wire.custom_sample import find_custom_messages
from snakesim_operator.results.recording_contents import CONTROLLER_SUFFIX
from snakesim_operator.results.run_log import RunRecord

PARQUET_UNIT = b"unit"  # metadata of a column of a Parquet file
JOINT_SIGNALS = ("angle_rad", "velocity_rad_s", "torque_nm", "mode", "target", "torque_limit_nm")

MEASURED_UNITS = {
    "time_s": "s",
    "age_s": "s",
    "angle_rad": "rad",
    "velocity_rad_s": "rad/s",
    "torque_nm": "N·m",
    "mode": "1",
    "target": "rad, rad/s or N·m, by mode",
    "torque_limit_nm": "N·m",
    "position_w_m": "m",
    "orientation_wxyz": "1",
    "contact_peak_n": "N",
    "contact_count": "1",
}
MOTION_UNITS = {
    "center_w_m": "m",
    "velocity_w_m_s": "m/s",
    "velocity_b_m_s": "m/s",
    "heading_w_rad": "rad",
    "turn_rate_rad_s": "rad/s",
}
CONTACT_UNITS = {
    "link_force_n": "N",
    "link_force_l_n": "N",
    "obstacle_force_n": "N",
    "obstacle_force_w_n": "N",
}
UNITS = MEASURED_UNITS | MOTION_UNITS | CONTACT_UNITS


def find_unit(name: str, record: RunRecord) -> str:
    """Find the unit of a column or of a whole signal, such as "rad/s"; "1" for a dimensionless value.

    The unit of a value that a controller defined is read from the end of its name.
    """
    signal = name.partition(".")[0]
    if name.endswith(f".{CONTROLLER_SUFFIX}"):
        return find_unit_in_name(signal) or "1"
    units: dict[str, str] = {}
    for message in find_custom_messages(record.description).values():
        units |= message.units
    units |= UNITS  # signals of SnakeSIM override custom sensors of the same name
    return units[signal]
