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
from snakesim_hal.model.kinematics import link_frames
from snakesim_hal.wire.messages import Axis, Description

GROUP_LINKS = 6  # links that are fitted together: three yaw and three pitch joints
FINAL_STEPS = 8  # Gauss-Newton steps of all joints, in the first keyframe
NEXT_STEPS = 2  # the same in each other keyframe, from the one before it
ROLL_WEIGHT = 1.0  # w
ANGLE_WEIGHT = 0.02  # v
DAMPING = 1e-6  # of a step, relative to the squared link length
KEYFRAMES = 16


@dataclass(frozen=True)
class Backbone:
    """A curve at one phase, as the places that the nodes of a chain should have."""

    nodes: Floats  # (n_joints + 2, 3) m, tail end to head end
    roll_normal: Floats  # (3,) unit vector that the middle link's y axis must be perpendicular to


class ChainFit:
    """The chain of one robot, which is laid on one curve after the other."""

    def __init__(self, robot: Description) -> None:
        self._axes: list[Axis] = [joint.axis for joint in robot.joints]
        self._lengths_m = np.array([link.length_m for link in robot.links])
        self._link_m = float(self._lengths_m.mean())
        self._middle = len(self._axes) // 2

        # The state of the fit.
        self.angles_rad = np.zeros(len(self._axes))
        self._position = np.zeros(3)
        self._rotation = np.eye(3)

    def fit_first(self, backbone: Backbone) -> Iterator[None]:
        """Fit from the tail to the head, group after group, and then all joints together. Yields after each step."""
        self._position = backbone.nodes[0].copy()
        self._rotation = _find_first_rotation(backbone)
        self.angles_rad = np.zeros(len(self._axes))
        joint_count = len(self._axes)
        for end in range(2, joint_count + 1):
            self._improve(backbone, max(end - GROUP_LINKS, 0), end)
            yield
        for _ in range(FINAL_STEPS):
            self._improve(backbone, 0, joint_count)
            yield

    def fit_next(self, backbone: Backbone) -> Iterator[None]:
        """Fit a curve that differs little from the last one. Yields after each step."""
        for _ in range(NEXT_STEPS):
            self._improve(backbone, 0, len(self._axes))
            yield

    def find_nodes(self) -> Floats:
        """Return the nodes of the fitted chain, (n_joints + 2, 3) m."""
        origins, rotations = self._find_frames()
        return np.vstack([origins, origins[-1] + self._lengths_m[-1] * rotations[-1][:, 0]])

    def _find_frames(self) -> tuple[Floats, Floats]:
        return link_frames(self._position, self._rotation, self.angles_rad, self._axes, self._lengths_m.tolist())

    def _improve(self, backbone: Backbone, first: int, end: int) -> None:
        """Do one Gauss-Newton step of the joints `first` to `end`, and of the base if the group begins at the tail."""
        origins, rotations = self._find_frames()
        nodes = np.vstack([origins, origins[-1] + self._lengths_m[-1] * rotations[-1][:, 0]])[: end + 2]
        with_base = first == 0
        pivots = origins[first + 1 : end + 1]  # (k, 3) of the joints
        columns = [0 if axis == "pitch" else 1 for axis in self._axes[first:end]]
        axes = np.array(
            [rotations[first + 1 + k][:, 2 if column else 1] for k, column in enumerate(columns)]
        )  # (k, 3) of rotation, unit

        # Derivatives of the nodes and of the middle link's y axis by rotations about points.
        angles = self.angles_rad[first:end]
        turned = np.cross(axes[:, None, :], nodes[None, :, :] - pivots[:, None, :])  # (k, n, 3)
        behind = np.arange(len(nodes))[None, :] <= np.arange(first + 1, end + 1)[:, None]
        turned[behind] = 0.0
        rolled = np.cross(axes, rotations[self._middle][:, 1])  # (k, 3)
        rolled[np.arange(first, end) >= self._middle] = 0.0
        residual = [(nodes - backbone.nodes[: end + 2]).ravel()]
        rows = [turned.reshape(len(angles), -1).T]
        if with_base:
            base_turned = np.cross(np.eye(3)[:, None, :], nodes[None, :, :] - self._position)  # (3, n, 3)
            base_moved = np.broadcast_to(np.eye(3)[:, None, :], (3, len(nodes), 3))
            rows[0] = np.hstack([rows[0], base_turned.reshape(3, -1).T, base_moved.reshape(3, -1).T])
        width = rows[0].shape[1]

        # The roll, once the chain reaches its middle.
        if end > self._middle:
            weight_m = ROLL_WEIGHT * self._link_m
            roll_row = np.zeros(width)
            roll_row[: len(angles)] = weight_m * rolled @ backbone.roll_normal
            if with_base:
                middle_y = rotations[self._middle][:, 1]
                roll_row[len(angles) : len(angles) + 3] = (
                    weight_m * np.cross(np.eye(3), middle_y) @ backbone.roll_normal
                )
            rows.append(roll_row[None, :])
            residual.append(np.array([weight_m * rotations[self._middle][:, 1] @ backbone.roll_normal]))

        # The angles.
        weight_m = ANGLE_WEIGHT * self._link_m
        rows.append(np.hstack([weight_m * np.eye(len(angles)), np.zeros((len(angles), width - len(angles)))]))
        residual.append(weight_m * angles)

        jacobian = np.vstack(rows)
        normal = jacobian.T @ jacobian + DAMPING * self._link_m**2 * np.eye(width)
        step = -np.linalg.solve(normal, jacobian.T @ np.concatenate(residual))
        self.angles_rad[first:end] += step[: len(angles)]
        if with_base:
            turned_base: Floats = np.array(step[len(angles) : len(angles) + 3], dtype=np.float64)
            self._rotation = _rotate(turned_base) @ self._rotation
            self._position = self._position + step[len(angles) + 3 :]


class KeyframeWaves:
    """The angles of all joints as Fourier series of the phase, through the fits of a curve at evenly spaced phases.

    The fit takes some tens of milliseconds, so a controller distributes its steps over control cycles.
    """

    def __init__(self, robot: Description, find_backbone: Callable[[float], Backbone], phases: int = KEYFRAMES) -> None:
        """Prepare the fit.

        Args:
            robot: description of the robot.
            find_backbone: returns the curve at a phase in rad; it must have the period 2 pi.
            phases: number of keyframes, which must be even.
        """
        self.fitted = False
        self.keyframes_rad = np.zeros((phases, len(robot.joints)))
        self.max_distance_m = 0.0  # of any node from its place on the curve
        self._chain = ChainFit(robot)
        self._find_backbone = find_backbone
        self._steps = self._fit_keyframes()
        self._orders: Floats = np.arange(phases // 2 + 1.0)
        self._cosines: Floats = np.zeros((len(self._orders), len(robot.joints)))
        self._sines: Floats = np.zeros_like(self._cosines)

    def fit(self, steps: int | None = None) -> bool:
        """Do some steps of the fit, or all that are left, and return whether the keyframes are complete."""
        done = 0
        while not self.fitted and done != steps:
            if next(self._steps, "finished") == "finished":
                self._extract_waves()
            done += 1
        return self.fitted

    def find_angles_rad(self, phase_rad: float) -> Floats:
        """Return the angles of all joints at a phase, (n_joints,); the keyframes must be complete."""
        turned: Floats = self._orders * phase_rad
        angles_rad: Floats = np.cos(turned) @ self._cosines + np.sin(turned) @ self._sines
        return angles_rad

    def _fit_keyframes(self) -> Iterator[None]:
        chain = self._chain
        phases = len(self.keyframes_rad)
        for number in range(phases):
            backbone = self._find_backbone(2.0 * np.pi * number / phases)
            yield from chain.fit_next(backbone) if number else chain.fit_first(backbone)
            self.keyframes_rad[number] = chain.angles_rad
            distances_m = np.linalg.norm(chain.find_nodes() - backbone.nodes, axis=1)
            self.max_distance_m = max(self.max_distance_m, float(distances_m.max()))

    def _extract_waves(self) -> None:
        """Compute the Fourier series. The highest order of an even number of keyframes has no sine."""
        phases = len(self.keyframes_rad)
        series = np.fft.rfft(self.keyframes_rad, axis=0) / phases
        series[1:-1] *= 2.0
        self._cosines = np.array(series.real, dtype=np.float64)
        self._sines = np.array(-series.imag, dtype=np.float64)
        self.fitted = True


def sample_by_arc_length(points: Floats, places: Sequence[float] | Floats) -> Floats:
    """Return the points of a curve at fractions of its arc length.

    Args:
        points: (n, 3) dense points of the curve.
        places: (m,) fractions, 0 at the first point.

    Returns:
        (m, 3).
    """
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    arc = np.concatenate(([0.0], np.cumsum(steps)))
    return np.stack([np.interp(np.asarray(places) * arc[-1], arc, points[:, k]) for k in range(3)], axis=1)


def _find_first_rotation(backbone: Backbone) -> Floats:
    """Return a base whose x axis is along the beginning of the curve, and whose y axis is as the roll wants it."""
    x = backbone.nodes[1] - backbone.nodes[0]
    x /= np.linalg.norm(x)
    y = np.cross(backbone.roll_normal, x)
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1).astype(np.float64)


def _rotate(vector: Floats) -> Floats:
    """Return the rotation by a vector (3,), whose length is the angle in rad (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
