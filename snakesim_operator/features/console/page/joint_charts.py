"""Live charts of the joints: every joint now, and the last seconds of all joints."""

from collections import deque
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import viser

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import JointMode, RobotDescription
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.features.console.scene.drawing import find_propulsion_joint
from snakesim_operator.features.console.scene.scene_colors import PROPULSION_JOINT
from snakesim_operator.results.page.palette import make_joint_colors

HISTORY_S = 10.0
MAX_SAMPLES = 400  # of one chart's history
CHART_HEIGHT_PX = 190
MEASURED_COLOR = "#0067b0"
REFERENCE_COLOR = "#c8321f"
LIMIT_COLOR = "#8b95a1"
PROPULSION_COLOR = "#" + bytes(PROPULSION_JOINT).hex()

SampleT = TypeVar("SampleT", bound=tuple[Any, ...])


def append_sample(history: deque[SampleT], sample: SampleT) -> None:
    """Add a sample of a time in s and values, unless it follows the last one too closely.

    A sample that is earlier than the last one starts the history again.
    """
    if history and sample[0] < history[-1][0]:
        history.clear()
    if not history or sample[0] - history[-1][0] >= HISTORY_S / MAX_SAMPLES:
        history.append(sample)


class JointCharts:
    """Angles against references and torques against limits, joint by joint, and both over time."""

    def __init__(self, gui: viser.GuiApi, robot: RobotDescription) -> None:
        """Add the charts of all joints to the page, without values.

        Args:
            gui: The page.
            robot: Description of the robot, whose limits are the scales of the charts.
        """
        self._joint_names = [joint.name for joint in robot.joints]
        self._joint_numbers = np.arange(1.0, len(robot.joints) + 1)
        self._torque_limits_nm = np.array([joint.torque_limit_nm for joint in robot.joints])
        # Time, angles, torques.
        self._history: deque[tuple[float, Floats, Floats]] = deque(maxlen=MAX_SAMPLES)

        max_angles_rad = np.array(
            [max(-joint.angle_min_rad, joint.angle_max_rad) for joint in robot.joints]
        )
        angle_scale = _make_fixed_scale(max_angles_rad)
        torque_scale = _make_fixed_scale(self._torque_limits_nm)
        self._angle_chart = self._add_angle_chart(gui, angle_scale)
        self._torque_chart = self._add_torque_chart(gui, torque_scale)
        self._angle_history_chart = add_history_chart(
            gui,
            self._joint_names,
            "Angle of all joints, last 10 s, rad",
            angle_scale,
            legend={"show": False},
        )
        self._torque_history_chart = add_history_chart(
            gui,
            self._joint_names,
            "Torque of all joints, last 10 s, N·m",
            torque_scale,
            legend={"show": False},
        )

    def _add_angle_chart(self, gui: viser.GuiApi, scale: dict[str, Any]) -> viser.GuiUplotHandle:
        unknown = np.full(len(self._joint_names), np.nan)
        lines = (
            {"label": "joint"},
            make_chart_line("measured", MEASURED_COLOR, dots=True),
            make_chart_line("reference", REFERENCE_COLOR, dash=True),
        )
        return gui.add_uplot(
            (self._joint_numbers, unknown, unknown),
            lines,  # pyright: ignore[reportArgumentType] - dictionaries of uPlot's options
            title="Angle of each joint, rad (tail to head)",
            height=CHART_HEIGHT_PX,
            scales={"x": {"time": False}, "y": scale},  # pyright: ignore[reportArgumentType]
        )

    def _add_torque_chart(self, gui: viser.GuiApi, scale: dict[str, Any]) -> viser.GuiUplotHandle:
        unknown = np.full(len(self._joint_names), np.nan)
        lines = (
            {"label": "joint"},
            make_chart_line("measured", MEASURED_COLOR, dots=True),
            make_chart_line("limit", LIMIT_COLOR, dash=True),
            make_chart_line("-limit", LIMIT_COLOR, dash=True),
            make_chart_line("propulsion", PROPULSION_COLOR, dots=True, dot_size_px=12),
        )
        return gui.add_uplot(
            (
                self._joint_numbers,
                unknown,
                self._torque_limits_nm,
                -self._torque_limits_nm,
                unknown,
            ),
            lines,  # pyright: ignore[reportArgumentType] - dictionaries of uPlot's options
            title="Torque of each joint, N·m",
            height=CHART_HEIGHT_PX,
            scales={"x": {"time": False}, "y": scale},  # pyright: ignore[reportArgumentType]
        )

    def remove(self) -> None:
        """Remove the charts from the page."""
        self._angle_chart.remove()
        self._torque_chart.remove()
        self._angle_history_chart.remove()
        self._torque_history_chart.remove()

    def add_snapshot(self, snapshot: RobotSnapshot) -> None:
        """Keep a sample for the charts over time; called for each frame."""
        joints = snapshot.joints
        if joints is None or snapshot.time_s is None:
            return
        append_sample(
            self._history, (snapshot.time_s, np.array(joints.angle_rad), np.array(joints.torque_nm))
        )

    def redraw(self, snapshot: RobotSnapshot) -> None:
        """Redraw all charts; called a few times a second."""
        joints = snapshot.joints
        if joints is None:
            return
        angles_rad = np.where(joints.valid, joints.angle_rad, np.nan)
        self._angle_chart.data = (self._joint_numbers, angles_rad, find_references_rad(snapshot))
        torques_nm = np.where(joints.valid, joints.torque_nm, np.nan)
        limits_nm = self._find_torque_limits_nm(snapshot)
        is_propulsion = np.arange(len(torques_nm)) == find_propulsion_joint(snapshot)
        propulsion_nm = np.where(is_propulsion, torques_nm, np.nan)
        self._torque_chart.data = (
            self._joint_numbers,
            torques_nm,
            limits_nm,
            -limits_nm,
            propulsion_nm,
        )
        if len(self._history) > 1:
            self._show_history()

    def _find_torque_limits_nm(self, snapshot: RobotSnapshot) -> Floats:
        """Return the torque limit of each joint, reduced where the host has derated it."""
        if snapshot.status is None:
            return self._torque_limits_nm
        fractions = [snapshot.status.derated.get(name, 1.0) for name in self._joint_names]
        return np.array(fractions) * self._torque_limits_nm

    def _show_history(self) -> None:
        times_s = np.array([time_s for time_s, _, _ in self._history])
        is_recent = times_s >= times_s[-1] - HISTORY_S
        angles_rad = np.array([angles for _, angles, _ in self._history])[is_recent]
        torques_nm = np.array([torques for _, _, torques in self._history])[is_recent]
        self._angle_history_chart.data = (times_s[is_recent], *np.ascontiguousarray(angles_rad.T))
        self._torque_history_chart.data = (times_s[is_recent], *np.ascontiguousarray(torques_nm.T))


def find_references_rad(snapshot: RobotSnapshot) -> Floats:
    """Return the angle at which each joint is to be, (joints,).

    This is the controller's reference, else the target of joints in position mode, else NaN.
    """
    joint_count = len(snapshot.robot.joints)
    control = snapshot.control
    if control is not None and len(control.reference_rad) == joint_count:
        return np.array(control.reference_rad)
    applied = snapshot.applied
    if applied is not None and len(applied.target) == len(applied.mode) == joint_count:
        return np.where(np.array(applied.mode) == JointMode.POSITION, applied.target, np.nan)
    return np.full(joint_count, np.nan)


def _make_fixed_scale(limits: Floats) -> dict[str, Any]:
    """Return a scale that ends just beyond the largest limit: viewers see how much is left below it."""
    end = 1.05 * float(limits.max())
    return {"range": (-end, end)}


def add_history_chart(
    gui: viser.GuiApi,
    names: Sequence[str],
    title: str,
    scale: dict[str, Any] | None = None,
    **options: Any,
) -> viser.GuiUplotHandle:
    """Add a chart over time in seconds, with an empty line for each name.

    Args:
        gui: The page.
        names: Names of the lines, in the order of their colors.
        title: Title of the chart.
        scale: Scale of the values as uPlot has it; None adapts it to the values.
        **options: Further options of `add_uplot`.
    """
    colors = make_joint_colors(len(names), dark=True).values()
    lines = [make_chart_line(name, color) for name, color in zip(names, colors, strict=True)]
    no_times = np.zeros(1)
    no_values = [np.full(1, np.nan)] * len(names)
    scales: dict[str, Any] = {"x": {"time": False}}
    if scale is not None:
        scales["y"] = scale
    return gui.add_uplot(
        (no_times, *no_values),
        ({"label": "s"}, *lines),
        title=title,
        height=CHART_HEIGHT_PX,
        scales=scales,
        **options,
    )


def make_chart_line(
    label: str, color: str, *, dash: bool = False, dots: bool = False, dot_size_px: int = 5
) -> Any:
    """Return the options of one line of a chart."""
    line: dict[str, Any] = {
        "label": label,
        "stroke": color,
        "width": 1.5,
        "points": {"show": False},
    }
    if dash:
        line["dash"] = [5, 4]
    if dots:
        line["points"] = {"show": True, "size": dot_size_px, "fill": color}
    return line
