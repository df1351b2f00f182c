"""Fits the joints of a robot to a curve in space, for robots whose yaw and pitch joints alternate.

Source: R. L. Hatton, H. Choset, "Generating gaits for snake robots: annealed chain fitting and keyframe wave
extraction", Autonomous Robots 28 (2010). Each joint of such a robot bends in one plane only. If links are laid on the
curve one by one, every second link cannot follow it. Therefore overlapping groups of links are fitted together: the
group moves along the chain link by link, and what lies behind it stays. At last all joints are improved together.

Here a fit minimizes, by damped Gauss-Newton steps,

    sum_j |p_j - c_j|^2 + (l w)^2 (y_m . n)^2 + (l v)^2 sum_i q_i^2

with the nodes p_j of the chain, their places c_j on the curve, the mean link length l, the y axis y_m of the middle
link, the direction n that it must be perpendicular to, and the joint angles q_i. The second term fixes the roll of the
body about its axis, and the third one the angles that the curve leaves open. These two terms are ours.

A gait is a curve for every phase. Its fits at evenly spaced phases are the keyframes. The waves of the joints between
them are the Fourier series through the keyframes.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import compute_link_frames
from snakesim_hal.wire.messages import Axis, RobotDescription

GROUP_LINKS = 6  # links that are fitted together: three yaw and three pitch joints
FINAL_STEPS = 8  # Gauss-Newton steps of all joints, in the first keyframe
STEPS_PER_NEXT_KEYFRAME = 2  # the same in each other keyframe, from the one before it
ROLL_WEIGHT = 1.0  # w
ANGLE_WEIGHT = 0.02  # v
DAMPING = 1e-6  # of a step, relative to the squared link length
KEYFRAME_COUNT = 16


@dataclass(frozen=True)
class BackboneCurve:
    """A curve at one phase, as the places that the nodes of a chain should have."""

    node_positions: Floats  # (n_joints + 2, 3) m, tail end to head end
    roll_normal: Floats  # (3,) unit vector that the middle link's y axis must be perpendicular to


class ChainFit:
    """The chain of one robot, which is laid on one curve after the other."""

    def __init__(self, robot: RobotDescription) -> None:
        self._axes: list[Axis] = [joint.axis for joint in robot.joints]
        self._lengths_m = np.array([link.length_m for link in robot.links])
        self._mean_link_length_m = float(self._lengths_m.mean())
        self._middle_link = len(self._axes) // 2

        # The state of the fit.
        self.angles_rad = np.zeros(len(self._axes))
        self._position = np.zeros(3)
        self._rotation = np.eye(3)

    def fit_first(self, backbone: BackboneCurve) -> Iterator[None]:
        """Fit the chain to a curve from the tail to the head, group after group, and then all joints together.

        Yields:
            None after each Gauss-Newton step.
        """
        self._position = backbone.node_positions[0].copy()
        self._rotation = _compute_initial_rotation(backbone)
        self.angles_rad = np.zeros(len(self._axes))
        joint_count = len(self._axes)
        for end in range(2, joint_count + 1):
            self._do_gauss_newton_step(backbone, max(end - GROUP_LINKS, 0), end)
            yield
        for _ in range(FINAL_STEPS):
            self._do_gauss_newton_step(backbone, 0, joint_count)
            yield

    def fit_next(self, backbone: BackboneCurve) -> Iterator[None]:
        """Fit the chain to a curve that differs little from the last one.

        Yields:
            None after each Gauss-Newton step.
        """
        for _ in range(STEPS_PER_NEXT_KEYFRAME):
            self._do_gauss_newton_step(backbone, 0, len(self._axes))
            yield

    def compute_node_positions(self) -> Floats:
        """Compute tail end, joints and head end of the fitted chain, (n_joints + 2, 3) in m."""
        origins, rotations = self._compute_link_frames()
        return np.vstack([origins, origins[-1] + self._lengths_m[-1] * rotations[-1][:, 0]])

    def _compute_link_frames(self) -> tuple[Floats, Floats]:
        return compute_link_frames(
            self._position, self._rotation, self.angles_rad, self._axes, self._lengths_m.tolist()
        )

    def _do_gauss_newton_step(
        self, backbone: BackboneCurve, first_joint_index: int, end_joint: int
    ) -> None:
        """Do one Gauss-Newton step of a group of joints, and of the base if the group begins at the tail.

        The unknowns are the angles of the k joints of the group and, with the base, its rotation (3) and translation
        (3). Three kinds of equations are stacked: the n nodes up to the end of the group are on the curve, the middle
        link has the roll of the curve, and the angles are small.

        Args:
            backbone: The curve that the chain is fitted to.
            first_joint_index: Index of the first joint of the group, from the tail.
            end_joint: Index after the last joint of the group.
        """
        origins, rotations = self._compute_link_frames()
        head_end = origins[-1] + self._lengths_m[-1] * rotations[-1][:, 0]
        points = np.vstack([origins, head_end])[: end_joint + 2]  # (n, 3) the nodes
        includes_base = first_joint_index == 0
        angles = self.angles_rad[first_joint_index:end_joint]
        pivots = origins[first_joint_index + 1 : end_joint + 1]  # (k, 3) positions of the joints
        # (k, 3) unit vectors about which the joints turn: the y axis of the link ahead for pitch, its z axis for yaw.
        axes = np.array(
            [
                rotations[joint + 1][:, 1 if self._axes[joint] == "pitch" else 2]
                for joint in range(first_joint_index, end_joint)
            ]
        )

        # The nodes. A joint turns all nodes ahead of it about its axis; those behind it stay. (k, n, 3)
        point_derivatives = np.cross(axes[:, None, :], points[None, :, :] - pivots[:, None, :])
        is_behind_joint = (
            np.arange(len(points))[None, :]
            <= np.arange(first_joint_index + 1, end_joint + 1)[:, None]
        )
        point_derivatives[is_behind_joint] = 0.0
        middle_y_derivatives = np.cross(axes, rotations[self._middle_link][:, 1])  # (k, 3)
        middle_y_derivatives[np.arange(first_joint_index, end_joint) >= self._middle_link] = 0.0
        residuals = [(points - backbone.node_positions[: end_joint + 2]).ravel()]
        rows = [point_derivatives.reshape(len(angles), -1).T]
        if includes_base:
            base_rotation_derivatives = np.cross(
                np.eye(3)[:, None, :], points[None, :, :] - self._position
            )  # (3, n, 3)
            base_translation_derivatives = np.broadcast_to(
                np.eye(3)[:, None, :], (3, len(points), 3)
            )
            rows[0] = np.hstack(
                [
                    rows[0],
                    base_rotation_derivatives.reshape(3, -1).T,
                    base_translation_derivatives.reshape(3, -1).T,
                ]
            )
        unknown_count = rows[0].shape[1]

        # The roll, once the chain reaches its middle.
        if end_joint > self._middle_link:
            weight_m = ROLL_WEIGHT * self._mean_link_length_m
            roll_row = np.zeros(unknown_count)
            roll_row[: len(angles)] = weight_m * middle_y_derivatives @ backbone.roll_normal
            if includes_base:
                middle_y = rotations[self._middle_link][:, 1]
                roll_row[len(angles) : len(angles) + 3] = (
                    weight_m * np.cross(np.eye(3), middle_y) @ backbone.roll_normal
                )
            rows.append(roll_row[None, :])
            residuals.append(
                np.array([weight_m * rotations[self._middle_link][:, 1] @ backbone.roll_normal])
            )

        # The angles, which should be small, so that joints that hardly move a node do not turn without need.
        weight_m = ANGLE_WEIGHT * self._mean_link_length_m
        rows.append(
            np.hstack(
                [
                    weight_m * np.eye(len(angles)),
                    np.zeros((len(angles), unknown_count - len(angles))),
                ]
            )
        )
        residuals.append(weight_m * angles)

        # The damped step. It is applied to the angles first, and then to the base.
        jacobian = np.vstack(rows)
        normal_matrix = jacobian.T @ jacobian + DAMPING * self._mean_link_length_m**2 * np.eye(
            unknown_count
        )
        solution_step = -np.linalg.solve(normal_matrix, jacobian.T @ np.concatenate(residuals))
        self.angles_rad[first_joint_index:end_joint] += solution_step[: len(angles)]
        if includes_base:
            base_rotation_step: Floats = np.array(
                solution_step[len(angles) : len(angles) + 3], dtype=np.float64
            )
            self._rotation = _make_rotation(base_rotation_step) @ self._rotation
            self._position = self._position + solution_step[len(angles) + 3 :]


class KeyframeWaves:
    """The angles of all joints as Fourier series of the phase, through the fits of a curve at evenly spaced phases.

    The fit takes some tens of milliseconds, so a controller distributes its steps over control cycles.
    """

    def __init__(
        self,
        robot: RobotDescription,
        compute_backbone: Callable[[float], BackboneCurve],
        phase_count: int = KEYFRAME_COUNT,
    ) -> None:
        """Prepare to fit the joints of a robot to the keyframes of a gait; `advance_fit` does the steps.

        Args:
            robot: Description of the robot.
            compute_backbone: Returns the curve at a phase in rad; it must have the period 2 pi.
            phase_count: Number of keyframes, which must be even.
        """
        self.is_fitted = False
        self.keyframes_rad = np.zeros((phase_count, len(robot.joints)))
        self.max_deviation_m = 0.0  # of any node from its place on the curve
        self._chain = ChainFit(robot)
        self._compute_backbone = compute_backbone
        self._steps = self._fit_keyframes()
        self._orders: Floats = np.arange(phase_count // 2 + 1.0)
        self._cosines: Floats = np.zeros((len(self._orders), len(robot.joints)))
        self._sines: Floats = np.zeros_like(self._cosines)

    def advance_fit(self, step_count: int | None = None) -> bool:
        """Do some steps of the fit, and compute the Fourier series when all keyframes are complete.

        Args:
            step_count: Maximum number of Gauss-Newton steps; None to complete the fit.

        Returns:
            Whether the keyframes are complete.
        """
        done_count = 0
        while not self.is_fitted and done_count != step_count:
            if next(self._steps, "finished") == "finished":
                self._compute_fourier_series()
            done_count += 1
        return self.is_fitted

    def compute_joint_angles_rad(self, phase_rad: float) -> Floats:
        """Evaluate the Fourier series of all joints at a phase, (n_joints,) in rad. The fit must be complete."""
        order_phases_rad: Floats = self._orders * phase_rad
        angles_rad: Floats = (
            np.cos(order_phases_rad) @ self._cosines + np.sin(order_phases_rad) @ self._sines
        )
        return angles_rad

    def _fit_keyframes(self) -> Iterator[None]:
        """Fit the chain at each phase, starting from the fit before it. Yields None after each Gauss-Newton step."""
        chain = self._chain
        phase_count = len(self.keyframes_rad)
        for keyframe_index in range(phase_count):
            backbone = self._compute_backbone(2.0 * np.pi * keyframe_index / phase_count)
            yield from chain.fit_next(backbone) if keyframe_index else chain.fit_first(backbone)
            self.keyframes_rad[keyframe_index] = chain.angles_rad
            distances_m = np.linalg.norm(
                chain.compute_node_positions() - backbone.node_positions, axis=1
            )
            self.max_deviation_m = max(self.max_deviation_m, float(distances_m.max()))

    def _compute_fourier_series(self) -> None:
        """Compute the Fourier series. The highest order of an even number of keyframes has no sine."""
        phase_count = len(self.keyframes_rad)
        series = np.fft.rfft(self.keyframes_rad, axis=0) / phase_count
        series[1:-1] *= 2.0
        self._cosines = np.array(series.real, dtype=np.float64)
        self._sines = np.array(-series.imag, dtype=np.float64)
        self.is_fitted = True


def sample_by_arc_length(points: Floats, fractions: Sequence[float] | Floats) -> Floats:
    """Return the points of a curve at fractions of its arc length.

    Args:
        points: (n, 3) dense points of the curve.
        fractions: (m,) fractions of the arc length, 0 at the first point and 1 at the last.

    Returns:
        (m, 3) points of the curve.
    """
    segment_lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    arc_lengths = np.concatenate(([0.0], np.cumsum(segment_lengths)))
    return np.stack(
        [
            np.interp(np.asarray(fractions) * arc_lengths[-1], arc_lengths, points[:, k])
            for k in range(3)
        ],
        axis=1,
    )


def _compute_initial_rotation(backbone: BackboneCurve) -> Floats:
    """Return a rotation matrix whose x axis is along the start of the curve, and whose y axis fits the roll normal."""
    x = backbone.node_positions[1] - backbone.node_positions[0]
    x /= np.linalg.norm(x)
    y = np.cross(backbone.roll_normal, x)
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1).astype(np.float64)


def _make_rotation(vector: Floats) -> Floats:
    """Return the matrix (3, 3) of the rotation about a vector (3,), whose length is the angle in rad (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
