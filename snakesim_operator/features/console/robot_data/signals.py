"""Every number of a robot over time, by name and unit; and those of the last minute of a live one.

Names are those of `snakesim plot` and `export`; what these do not have has the name of its message before it:
`control.reference_rad.joint_3`, `power.voltage_v.joint_1`, `imu.acceleration_m_s2.0.x`.
"""

import threading
from collections import deque
from functools import cache
from typing import Any, Protocol

import msgspec
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.run_log.black_box import touching
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import AppliedCommand, ControlState, Description, Imu, JointState, Message, Power
from snakesim_hal.wire.own_sample import own_kinds
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot

LIVE_S, LIVE_EVERY_S = 60.0, 0.05
OF_JOINTS: dict[type[Message], tuple[str, ...]] = {
    JointState: ("angle_rad", "velocity_rad_s", "torque_nm"),
    AppliedCommand: ("mode", "target", "torque_limit_nm"),
}
OTHERS = {"mode": "1", "position_w_m": "m", "orientation_wxyz": "1", "contact_peak_n": "N", "contact_count": "1"}
PREFIXED: dict[str, type[Message]] = {keys.CONTROL_STATE: ControlState, keys.POWER: Power, keys.IMU: Imu}


class Signals(Protocol):
    """Where signals come from. From any thread."""

    recorded: bool

    def units(self) -> dict[str, str]:
        """Of every signal there is, by name."""
        ...

    def series(self, name: str) -> tuple[Floats, Floats]:
        """Times in s since the first tick, and values, (n,) each; NaN where unknown. Raises KeyError."""
        ...


class LiveSignals:
    """Of a live robot: the last minute that the page has seen, twenty times a second."""

    recorded = False

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._kept: deque[tuple[float, tuple[str, ...], Floats]] = deque(maxlen=round(LIVE_S / LIVE_EVERY_S))
        self._units: dict[str, str] = {}

    def take(self, snapshot: RobotSnapshot) -> None:
        """Keep what is known now; each frame."""
        time_s = snapshot.time_s
        if time_s is None or (self._kept and 0 <= time_s - self._kept[-1][0] < LIVE_EVERY_S):
            return
        now, of_units = _live(snapshot)
        with self._lock:
            if self._kept and time_s < self._kept[-1][0]:
                self._kept.clear()
                self._units.clear()
            self._units |= of_units
            self._kept.append((time_s, tuple(now), np.fromiter(now.values(), dtype=float, count=len(now))))

    def now_s(self) -> float | None:
        """Robot time of the newest."""
        with self._lock:
            return self._kept[-1][0] if self._kept else None

    def units(self) -> dict[str, str]:
        """Of every signal there is, by name."""
        with self._lock:
            return dict(self._units)

    def series(self, name: str) -> tuple[Floats, Floats]:
        """Robot times and values of one. Raises KeyError."""
        with self._lock:
            if name not in self._units:
                raise KeyError(name)
            kept = list(self._kept)
        values = [row[names.index(name)] if name in names else np.nan for _, names, row in kept]
        return np.array([time_s for time_s, _, _ in kept]), np.array(values)


def numbers(message: Message, robot: Description) -> dict[str, float]:
    """Of a message, by signal."""
    found: dict[str, float] = {}
    prefix = type(message).__name__.removesuffix("State").lower()
    for field in units(type(message)):
        _spread(f"{prefix}.{field}", getattr(message, field), robot, found)
    return found


@cache
def units(kind: type[Message]) -> dict[str, str]:
    """Of each field that holds numbers with a unit."""
    fields = msgspec.json.schema(kind)["$defs"][kind.__name__]["properties"]
    found = {name: _unit(about) for name, about in fields.items() if name != "timestamp_ns"}
    return {name: unit for name, unit in found.items() if unit is not None}


def _unit(about: Any) -> str | None:
    if isinstance(about, dict):
        return about["unit"] if "unit" in about else _unit(list(about.values()))
    if isinstance(about, list):
        return next((unit for one in about if (unit := _unit(one)) is not None), None)
    return None


def _spread(name: str, value: Any, robot: Description, found: dict[str, float]) -> None:
    if isinstance(value, list | tuple):
        of_joints = isinstance(value, list) and len(value) == len(robot.joints)
        parts = [joint.name for joint in robot.joints] if of_joints else range(len(value))
        for part, one in zip("xyz" if isinstance(value, tuple) and len(value) == 3 else parts, value, strict=True):
            _spread(f"{name}.{part}", one, robot, found)
    else:
        found[name] = np.nan if value is None else float(value)


def _live(snapshot: RobotSnapshot) -> tuple[dict[str, float], dict[str, str]]:
    """Values and units, by signal, under the names of a recording's."""
    robot, found, of_units = snapshot.robot, dict[str, float](), dict[str, str]()
    for message in (snapshot.joints, snapshot.applied):
        for name in () if message is None else OF_JOINTS[type(message)]:
            unit = {**OTHERS, **units(type(message))}[name]
            for joint, value in zip(robot.joints, getattr(message, name), strict=False):
                found[f"{name}.{joint.name}"], of_units[f"{name}.{joint.name}"] = float(value), unit
    if snapshot.base is not None:
        found |= {f"position_w_m.{axis}": value for axis, value in zip("xyz", snapshot.base[0], strict=True)}
        found |= {f"orientation_wxyz.{axis}": value for axis, value in zip("wxyz", snapshot.base[1], strict=True)}
    if snapshot.contacts is not None:
        peak_n, count = touching(snapshot.contacts)
        found |= {"contact_peak_n": peak_n, "contact_count": float(count)}
    of_units |= {name: OTHERS[name.partition(".")[0]] for name in found if name not in of_units}
    for message in (snapshot.control, snapshot.power, snapshot.imu):
        if message is not None:
            more = numbers(message, robot)
            found |= more
            of_units |= {name: units(type(message))[name.split(".")[1]] for name in more}
    for key, kind in own_kinds(robot).items():
        if (sample := snapshot.own.get(key)) is not None:
            for name, value in kind.numbers(sample).items():
                field, dot, part = name.partition(".")
                full = f"{field}.{key.rpartition('/')[2]}{dot}{part}"
                found[full], of_units[full] = value, kind.units[field]
    return found, of_units
