"""Live charts: every joint now, and the last seconds of all joints."""

from collections import deque
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import viser

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import Description, Mode
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.features.console.scene.drawing import pushing_joint
from snakesim_operator.features.console.scene.robot_scene import PROPELS
from snakesim_operator.results.page.palette import joint_colors

HISTORY_S = 10.0
SAMPLES_MOST = 400
ANGLE, REFERENCE, LIMIT = "#0067b0", "#c8321f", "#8b95a1"
PUSH = "#" + bytes(PROPELS).hex()


SampleT = TypeVar("SampleT", bound=tuple[Any, ...])


def keep(history: deque[SampleT], sample: SampleT) -> None:
    """Add a sample, of a time and values, if it is later by enough; after going back history begins with it."""
    if history and sample[0] < history[-1][0]:
        history.clear()
    if not history or sample[0] - history[-1][0] >= HISTORY_S / SAMPLES_MOST:
        history.append(sample)


class JointCharts:
    """Angles against references and torques against limits, joint by joint; and both over time."""

    def __init__(self, gui: viser.GuiApi, robot: Description) -> None:
        count = len(robot.joints)
        self._limits = np.array([joint.torque_limit_nm for joint in robot.joints])
        self._names = [joint.name for joint in robot.joints]
        self._number = np.arange(1.0, count + 1)
        self._history: deque[tuple[float, Floats, Floats]] = deque(maxlen=SAMPLES_MOST)
        angles = np.array([max(-joint.angle_min_rad, joint.angle_max_rad) for joint in robot.joints])
        unknown = np.full(count, np.nan)
        self._angles = gui.add_uplot(
            (self._number, unknown, unknown),
            ({"label": "joint"}, line("measured", ANGLE, dots=True), line("reference", REFERENCE, dash=True)),
            title="Angle of each joint, rad (tail to head)",
            height=190,
            scales={"x": {"time": False}, "y": _range(angles)},
        )
        self._torques = gui.add_uplot(
            (self._number, unknown, self._limits, -self._limits, unknown),
            (
                {"label": "joint"},
                line("measured", ANGLE, dots=True),
                line("limit", LIMIT, dash=True),
                line("-limit", LIMIT, dash=True),
                line("propulsion", PUSH, dots=True, size=12),
            ),
            title="Torque of each joint, N·m",
            height=190,
            scales={"x": {"time": False}, "y": _range(self._limits)},
        )
        self._angles_then, self._torques_then = (
            over_time(gui, self._names, title, {"y": _range(most)}, legend={"show": False})
            for title, most in (
                ("Angle of all joints, last 10 s, rad", angles),
                ("Torque of all joints, last 10 s, N·m", self._limits),
            )
        )

    def remove(self) -> None:
        """Take them off the page."""
        for chart in (self._angles, self._torques, self._angles_then, self._torques_then):
            chart.remove()

    def take(self, snapshot: RobotSnapshot) -> None:
        """Keep a sample for the charts over time; each frame."""
        joints, time_s = snapshot.joints, snapshot.time_s
        if joints is not None and time_s is not None:
            keep(self._history, (time_s, np.array(joints.angle_rad), np.array(joints.torque_nm)))

    def show(self, snapshot: RobotSnapshot) -> None:
        """Redraw them; a few times a second."""
        joints = snapshot.joints
        if joints is None:
            return
        measured = np.where(joints.valid, joints.angle_rad, np.nan)
        self._angles.data = (self._number, measured, references_rad(snapshot))
        derated = {} if snapshot.status is None else snapshot.status.derated
        limits = np.array([derated.get(name, 1.0) for name in self._names]) * self._limits
        torque = np.where(joints.valid, joints.torque_nm, np.nan)
        pushing = pushing_joint(snapshot)
        marked = np.where(np.arange(len(torque)) == pushing, torque, np.nan)
        self._torques.data = (self._number, torque, limits, -limits, marked)
        if len(self._history) > 1:
            times = np.array([sample[0] for sample in self._history])
            kept = times >= times[-1] - HISTORY_S
            for chart, which in ((self._angles_then, 1), (self._torques_then, 2)):
                values = np.array([sample[which] for sample in self._history])[kept]
                chart.data = (times[kept], *np.ascontiguousarray(values.T))


def references_rad(snapshot: RobotSnapshot) -> Floats:
    """Where each joint is to be: the controller's reference, else the target of joints in position mode; else NaN."""
    count = len(snapshot.robot.joints)
    control, applied = snapshot.control, snapshot.applied
    if control is not None and len(control.reference_rad) == count:
        return np.array(control.reference_rad)
    if applied is not None and len(applied.target) == len(applied.mode) == count:
        return np.where(np.array(applied.mode) == Mode.POSITION, applied.target, np.nan)
    return np.full(count, np.nan)


def _range(most: Floats) -> Any:
    """A fixed scale up to the limits: one sees how much is left, and values that are unknown do not matter."""
    return {"range": (-1.05 * float(most.max()), 1.05 * float(most.max()))}


def over_time(gui: viser.GuiApi, names: Sequence[str], title: str, scale: Any = None, **more: Any) -> Any:
    """A chart with a line for each name, still empty. scale: of the values; None: as they come."""
    colors = joint_colors(len(names), dark=True).values()
    return gui.add_uplot(
        (np.zeros(1), *[np.full(1, np.nan)] * len(names)),
        ({"label": "s"}, *(line(name, color) for name, color in zip(names, colors, strict=True))),
        title=title,
        height=190,
        scales={"x": {"time": False}, **(scale or {})},
        **more,
    )


def line(label: str, stroke: str, *, dash: bool = False, dots: bool = False, size: int = 5) -> Any:
    """One line of a chart."""
    series: dict[str, Any] = {"label": label, "stroke": stroke, "width": 1.5, "points": {"show": False}}
    if dash:
        series["dash"] = [5, 4]
    if dots:
        series["points"] = {"show": True, "size": size, "fill": stroke}
    return series
