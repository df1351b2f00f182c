"""Every number of a robot over time, by name and unit, and the last minute of these numbers for a live robot.

Names are those of `snakesim recording plot` and `snakesim recording export`. A number that these commands do not
have has the name of its message in front: `control.reference_rad.joint_3`, `power.voltage_v.joint_1`,
`imu.acceleration_m_s2.0.x`.
"""

import threading
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Protocol

import msgspec
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.fields.field_words import find_unit_in_name
from snakesim_hal.run_log.black_box import summarize_contacts
from snakesim_hal.wire import keys
from snakesim_hal.wire.custom_sample import find_custom_messages
from snakesim_hal.wire.messages import (
    AppliedCommand,
    ControlState,
    Imu,
    JointState,
    Message,
    Power,
    RobotDescription,
)
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot

LIVE_HISTORY_S = 60.0
LIVE_PERIOD_S = 0.05  # between two samples of a live robot

# Fields with a number for each joint, whose names have no message in front.
JOINT_FIELDS: dict[type[Message], tuple[str, ...]] = {
    JointState: ("angle_rad", "velocity_rad_s", "torque_nm"),
    AppliedCommand: ("mode", "target", "torque_limit_nm"),
}
# Units of signals whose message does not have a unit for them.
OTHER_UNITS = {
    "mode": "1",
    "position_w_m": "m",
    "orientation_wxyz": "1",
    "contact_peak_n": "N",
    "contact_count": "1",
}
# Messages whose signals have the name of the message in front.
PREFIXED_MESSAGES: dict[str, type[Message]] = {
    keys.CONTROL_STATE: ControlState,
    keys.POWER: Power,
    keys.IMU: Imu,
}


class SignalSource(Protocol):
    """A source of signals. Every method may be called from any thread."""

    recorded: bool

    def get_units(self) -> dict[str, str]:
        """Return the unit of every signal, by the signal's name."""
        ...

    def read_series(self, name: str) -> tuple[Floats, Floats]:
        """Return the times and the values of a signal.

        Returns:
            Times in s since the first tick, (n,), and values, (n,); NaN where the value is unknown.

        Raises:
            KeyError: There is no signal of this name.
        """
        ...


@dataclass(frozen=True)
class _LiveValues:
    """The numbers of a live robot at one time."""

    time_s: float
    names: tuple[str, ...]
    values: Floats  # (names,)


class LiveSignals:
    """The signals of a live robot: the last minute that the page has seen, twenty times a second."""

    recorded = False

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._samples: deque[_LiveValues] = deque(maxlen=round(LIVE_HISTORY_S / LIVE_PERIOD_S))
        self._units: dict[str, str] = {}

    def add_snapshot(self, snapshot: RobotSnapshot) -> None:
        """Keep the numbers of a snapshot, unless it follows the last one too closely; called for each frame."""
        time_s = snapshot.time_s
        if time_s is None:
            return
        if self._samples and 0 <= time_s - self._samples[-1].time_s < LIVE_PERIOD_S:
            return
        numbers = collect_signal_values(snapshot)
        values = np.fromiter(numbers.values.values(), dtype=float, count=len(numbers.values))
        with self._lock:
            # The robot was reset, or is another one.
            if self._samples and time_s < self._samples[-1].time_s:
                self._samples.clear()
                self._units.clear()
            self._units |= numbers.units
            self._samples.append(_LiveValues(time_s, tuple(numbers.values), values))

    def now_s(self) -> float | None:
        """Return the robot time of the newest sample, if there is one."""
        with self._lock:
            return self._samples[-1].time_s if self._samples else None

    def get_units(self) -> dict[str, str]:
        with self._lock:
            return dict(self._units)

    def read_series(self, name: str) -> tuple[Floats, Floats]:
        with self._lock:
            if name not in self._units:
                raise KeyError(name)
            samples = list(self._samples)
        values: list[float] = []
        for sample in samples:
            is_known = name in sample.names
            values.append(sample.values[sample.names.index(name)] if is_known else np.nan)
        return np.array([sample.time_s for sample in samples]), np.array(values)


def list_message_numbers(message: Message, robot: RobotDescription) -> dict[str, float]:
    """Return the numbers of a message that have a unit, by signal."""
    numbers: dict[str, float] = {}
    prefix = type(message).__name__.removesuffix("State").lower()
    for field_name in find_units(type(message)):
        _flatten_fields(f"{prefix}.{field_name}", getattr(message, field_name), robot, numbers)
    return numbers


@cache
def find_units(message_type: type[Message]) -> dict[str, str]:
    """Return the unit of each field of a message that holds numbers with a unit, by the field's name."""
    properties = msgspec.json.schema(message_type)["$defs"][message_type.__name__]["properties"]
    units: dict[str, str] = {}
    for field_name, schema in properties.items():
        unit = _find_unit(schema)
        if unit is not None and field_name != "timestamp_ns":
            units[field_name] = unit
    return units


def _find_unit(schema: Any) -> str | None:
    """Return the first unit in a JSON schema, which may be nested."""
    if isinstance(schema, dict):
        if "unit" in schema:
            return schema["unit"]
        return _find_first_unit(schema.values())
    if isinstance(schema, list):
        return _find_first_unit(schema)
    return None


def _find_first_unit(schemas: Iterable[Any]) -> str | None:
    for schema in schemas:
        unit = _find_unit(schema)
        if unit is not None:
            return unit
    return None


def _flatten_fields(
    name: str, value: Any, robot: RobotDescription, numbers: dict[str, float]
) -> None:
    """Add each number of a field to `numbers`, under the field's name and the name of each part."""
    if isinstance(value, dict):
        parts = list(value.items())
    elif isinstance(value, list | tuple):
        parts = list(zip(_name_parts(value, robot), value, strict=True))
    else:
        numbers[name] = np.nan if value is None else float(value)
        return
    for part, element in parts:
        _flatten_fields(f"{name}.{part}", element, robot, numbers)


def _name_parts(values: list[Any] | tuple[Any, ...], robot: RobotDescription) -> Iterable[object]:
    """Return the names of a field's parts: axes of a vector, joints of a list with one value for each, else indices."""
    if isinstance(values, tuple) and len(values) == 3:
        return "xyz"
    if isinstance(values, list) and len(values) == len(robot.joints):
        return [joint.name for joint in robot.joints]
    return range(len(values))


@dataclass
class SignalValues:
    """Values and units, by signal."""

    values: dict[str, float] = field(default_factory=dict[str, float])
    units: dict[str, str] = field(default_factory=dict[str, str])

    def add(self, name: str, value: float, unit: str) -> None:
        """Add a signal."""
        self.values[name] = value
        self.units[name] = unit

    def add_axes(self, name: str, axes: str, values: Iterable[float]) -> None:
        """Add a signal for each axis of a vector. `name` is a key of OTHER_UNITS."""
        for axis, value in zip(axes, values, strict=True):
            self.add(f"{name}.{axis}", value, OTHER_UNITS[name])


def collect_signal_values(snapshot: RobotSnapshot) -> SignalValues:
    """Collect the values of all signals of a snapshot, under the names that the signals have in a recording."""
    signal_values = SignalValues()
    _add_joint_numbers(signal_values, snapshot)
    if snapshot.base is not None:
        position_w, orientation_wxyz = snapshot.base
        signal_values.add_axes("position_w_m", "xyz", position_w)
        signal_values.add_axes("orientation_wxyz", "wxyz", orientation_wxyz)
    if snapshot.contacts is not None:
        peak_n, contact_count = summarize_contacts(snapshot.contacts)
        signal_values.add("contact_peak_n", peak_n, OTHER_UNITS["contact_peak_n"])
        signal_values.add("contact_count", float(contact_count), OTHER_UNITS["contact_count"])
    for message in (snapshot.control, snapshot.power, snapshot.imu):
        if message is not None:
            values_by_name = list_message_numbers(message, snapshot.robot)
            for name, value in values_by_name.items():
                signal_values.add(name, value, find_signal_unit(name, type(message)))
    _add_sensor_numbers(signal_values, snapshot)
    return signal_values


def find_signal_unit(name: str, message_type: type[Message]) -> str:
    """Return the unit of a signal whose name begins with that of a message, such as `control.propulsion_n`.

    A number that a controller defined has the unit in which its name ends.
    """
    field_name = name.split(".")[1]
    if field_name == "custom":
        return find_unit_in_name(name) or "1"
    return find_units(message_type)[field_name]


def _add_joint_numbers(signal_values: SignalValues, snapshot: RobotSnapshot) -> None:
    for message in (snapshot.joints, snapshot.applied):
        if message is None:
            continue
        units: Mapping[str, str] = {**OTHER_UNITS, **find_units(type(message))}
        for field_name in JOINT_FIELDS[type(message)]:
            values = getattr(message, field_name)
            for joint, value in zip(snapshot.robot.joints, values, strict=False):
                signal_values.add(f"{field_name}.{joint.name}", float(value), units[field_name])


def _add_sensor_numbers(signal_values: SignalValues, snapshot: RobotSnapshot) -> None:
    """Add the numbers of custom sensors: field, sensor, and part of a list."""
    for key, kind in find_custom_messages(snapshot.robot).items():
        sample = snapshot.custom.get(key)
        if sample is None:
            continue
        sensor = key.rpartition("/")[2]
        for name, value in kind.extract_numeric_values(sample).items():
            field_name, dot, part = name.partition(".")
            signal_values.add(f"{field_name}.{sensor}{dot}{part}", value, kind.units[field_name])
