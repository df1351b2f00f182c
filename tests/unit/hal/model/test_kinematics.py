"""Forward kinematics against an independent calculation, and the fast path for planar chains against the full one."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import (
    compute_joint_rotation,
    compute_link_frames,
    quaternion_from_yaw,
    rotation_from_quaternion,
    yaw_from_rotation,
)

ANGLE = st.floats(-3, 3)
SHARE = st.floats(-1, 1)


@st.composite
def quaternions(draw: st.DrawFn) -> tuple[float, float, float, float]:
    wxyz = np.array([draw(SHARE) for _ in range(4)])
    size = float(np.linalg.norm(wxyz))
    w, x, y, z = (wxyz / size).tolist() if size > 0.1 else (1.0, 0.0, 0.0, 0.0)
    return w, x, y, z


@st.composite
def chains(draw: st.DrawFn) -> tuple[list[str], list[float], list[float]]:
    """Axes, angles and lengths."""
    axes = draw(st.lists(st.sampled_from(["yaw", "pitch"]), min_size=1, max_size=10))
    angles = [draw(ANGLE) for _ in axes]
    return axes, angles, [draw(st.floats(0.02, 0.5)) for _ in range(len(axes) + 1)]


def turn(vector: Floats, wxyz: tuple[float, float, float, float]) -> Floats:
    """q v q*, by the vector formula."""
    w, axis = wxyz[0], np.array(wxyz[1:])
    return vector + 2 * w * np.cross(axis, vector) + 2 * np.cross(axis, np.cross(axis, vector))


def homogeneous(
    axes: list[str], angles: list[float], lengths: list[float], base: Floats
) -> list[Floats]:
    """Frames of all links as a product of 4 x 4 matrices."""
    frames = [base]
    for axis, angle, length in zip(axes, angles, lengths, strict=False):
        step = np.eye(4)
        step[0, 3] = length
        c, s = math.cos(angle), math.sin(angle)
        rotation = np.eye(4)
        i, j = (0, 1) if axis == "yaw" else (2, 0)  # right-handed about z: x to y; about y: z to x
        rotation[i, i] = rotation[j, j] = c
        rotation[j, i], rotation[i, j] = s, -s
        frames.append(frames[-1] @ step @ rotation)
    return frames


@given(chain=chains(), wxyz=quaternions(), at=st.tuples(SHARE, SHARE, SHARE))
def test_frames_agree_with_a_product_of_matrices(
    chain: tuple[list[str], list[float], list[float]],
    wxyz: tuple[float, float, float, float],
    at: tuple[float, float, float],
) -> None:
    axes, angles, lengths = chain
    base = np.eye(4)
    base[:3, :3], base[:3, 3] = rotation_from_quaternion(wxyz), at
    origins, rotations = compute_link_frames(at, base[:3, :3], angles, axes, lengths)
    for i, frame in enumerate(homogeneous(axes, angles, lengths, base)):
        assert origins[i] == pytest.approx(frame[:3, 3], abs=1e-9)
        assert rotations[i] == pytest.approx(frame[:3, :3], abs=1e-9)


@given(chain=chains(), wxyz=quaternions())
def test_the_planar_shortcut_is_the_full_calculation(
    chain: tuple[list[str], list[float], list[float]], wxyz: tuple[float, float, float, float]
) -> None:
    """A pitch joint that is straight at the head's end forces the full calculation without moving anything."""
    _, angles, lengths = chain
    planar = ["yaw"] * len(angles)
    base = rotation_from_quaternion(wxyz)
    short_o, short_r = compute_link_frames((1.0, 2.0, 3.0), base, np.array(angles), planar, lengths)
    full_o, full_r = compute_link_frames(
        (1.0, 2.0, 3.0), base, [*angles, 0.0], [*planar, "pitch"], [*lengths, 0.1]
    )
    assert short_o == pytest.approx(full_o[:-1], abs=1e-9)
    assert short_r == pytest.approx(full_r[:-1], abs=1e-9)


QUARTER_TURN_RAD = math.pi / 2


def test_positive_yaw_turns_next_link_left() -> None:
    origins, rotations = compute_link_frames(
        (0, 0, 0), np.eye(3), [QUARTER_TURN_RAD], ["yaw"], [1.0, 1.0]
    )
    assert origins[1] == pytest.approx([1, 0, 0])
    assert rotations[1][:, 0] == pytest.approx([0, 1, 0])


def test_positive_pitch_turns_next_link_down() -> None:
    """Pitch is right-handed about y, which points left."""
    _, rotations = compute_link_frames(
        (0, 0, 0), np.eye(3), [QUARTER_TURN_RAD], ["pitch"], [1.0, 1.0]
    )
    assert rotations[1][:, 0] == pytest.approx([0, 0, -1])


def test_pitch_after_yaw_turns_about_yawed_axis() -> None:
    angles_rad = [QUARTER_TURN_RAD, QUARTER_TURN_RAD]
    origins, rotations = compute_link_frames(
        (0, 0, 0), np.eye(3), angles_rad, ["yaw", "pitch"], [1.0, 2.0, 1.0]
    )
    assert origins[2] == pytest.approx([1, 2, 0])
    assert rotations[2][:, 0] == pytest.approx([0, 0, -1])


@given(wxyz=quaternions(), vector=st.tuples(SHARE, SHARE, SHARE))
def test_rotations_turn_as_their_quaternions_do(
    wxyz: tuple[float, float, float, float], vector: tuple[float, float, float]
) -> None:
    rotation = rotation_from_quaternion(wxyz)
    assert rotation @ np.array(vector) == pytest.approx(turn(np.array(vector), wxyz), abs=1e-9)
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert rotation_from_quaternion(3.0 * np.array(wxyz)) == pytest.approx(rotation, abs=1e-9)


@given(yaw=st.floats(-3.1, 3.1))
def test_yaw_there_and_back(yaw: float) -> None:
    rotation = rotation_from_quaternion(quaternion_from_yaw(yaw))
    assert yaw_from_rotation(rotation) == pytest.approx(yaw, abs=1e-9)
    assert rotation == pytest.approx(compute_joint_rotation("yaw", yaw), abs=1e-9)
