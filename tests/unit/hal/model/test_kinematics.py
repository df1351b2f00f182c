"""Forward kinematics equals an independent calculation, and the fast planar path equals the full one."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import (
    compute_joint_rotation,
    compute_link_frames,
    quaternion_from_yaw,
    rotation_from_quaternion,
    yaw_from_rotation,
)

ANGLES_RAD = st.floats(-3, 3)
FRACTIONS = st.floats(-1, 1)


@st.composite
def draw_quaternion(draw: st.DrawFn) -> tuple[float, float, float, float]:
    """Draw a unit quaternion (w, x, y, z)."""
    wxyz = np.array([draw(FRACTIONS) for _ in range(4)])
    norm = float(np.linalg.norm(wxyz))
    w, x, y, z = (wxyz / norm).tolist() if norm > 0.1 else (1.0, 0.0, 0.0, 0.0)
    return w, x, y, z


@st.composite
def draw_chain(draw: st.DrawFn) -> tuple[list[str], list[float], list[float]]:
    """Draw axes, angles in rad and lengths in m of a chain."""
    axes = draw(st.lists(st.sampled_from(["yaw", "pitch"]), min_size=1, max_size=10))
    angles = [draw(ANGLES_RAD) for _ in axes]
    return axes, angles, [draw(st.floats(0.02, 0.5)) for _ in range(len(axes) + 1)]


def rotate_vector(vector: Floats, wxyz: tuple[float, float, float, float]) -> Floats:
    """Rotate a vector by a quaternion: q v q*, written with cross products."""
    w = wxyz[0]
    axis = np.array(wxyz[1:])
    return vector + 2 * w * np.cross(axis, vector) + 2 * np.cross(axis, np.cross(axis, vector))


def compute_frames_by_matrices(
    axes: list[str], angles: list[float], lengths: list[float], base: Floats
) -> list[Floats]:
    """Compute the frames of all links as products of 4 x 4 matrices."""
    frames = [base]
    for axis, angle, length in zip(axes, angles, lengths, strict=False):
        step = np.eye(4)
        step[0, 3] = length
        cosine = math.cos(angle)
        sine = math.sin(angle)
        rotation = np.eye(4)
        i, j = (0, 1) if axis == "yaw" else (2, 0)  # right-handed about z: x to y; about y: z to x
        rotation[i, i] = cosine
        rotation[j, j] = cosine
        rotation[j, i] = sine
        rotation[i, j] = -sine
        frames.append(frames[-1] @ step @ rotation)
    return frames


@given(
    chain=draw_chain(),
    wxyz=draw_quaternion(),
    position_w=st.tuples(FRACTIONS, FRACTIONS, FRACTIONS),
)
def test_link_frames_equal_a_product_of_matrices(
    chain: tuple[list[str], list[float], list[float]],
    wxyz: tuple[float, float, float, float],
    position_w: tuple[float, float, float],
) -> None:
    axes, angles, lengths = chain
    base = np.eye(4)
    base[:3, :3] = rotation_from_quaternion(wxyz)
    base[:3, 3] = position_w
    origins, rotations = compute_link_frames(position_w, base[:3, :3], angles, axes, lengths)
    for i, frame in enumerate(compute_frames_by_matrices(axes, angles, lengths, base)):
        assert origins[i] == pytest.approx(frame[:3, 3], abs=1e-9)
        assert rotations[i] == pytest.approx(frame[:3, :3], abs=1e-9)


@given(chain=draw_chain(), wxyz=draw_quaternion())
def test_link_frames_of_planar_chain_equal_the_full_calculation(
    chain: tuple[list[str], list[float], list[float]], wxyz: tuple[float, float, float, float]
) -> None:
    """Add a straight pitch joint at the head, which forces the full calculation and moves no link."""
    _, angles, lengths = chain
    planar = ["yaw"] * len(angles)
    base = rotation_from_quaternion(wxyz)
    fast_origins, fast_rotations = compute_link_frames(
        (1.0, 2.0, 3.0), base, np.array(angles), planar, lengths
    )
    full_origins, full_rotations = compute_link_frames(
        (1.0, 2.0, 3.0), base, [*angles, 0.0], [*planar, "pitch"], [*lengths, 0.1]
    )
    assert fast_origins == pytest.approx(full_origins[:-1], abs=1e-9)
    assert fast_rotations == pytest.approx(full_rotations[:-1], abs=1e-9)


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


@given(wxyz=draw_quaternion(), vector=st.tuples(FRACTIONS, FRACTIONS, FRACTIONS))
def test_rotation_matrix_rotates_as_its_quaternion(
    wxyz: tuple[float, float, float, float], vector: tuple[float, float, float]
) -> None:
    rotation = rotation_from_quaternion(wxyz)
    assert rotation @ np.array(vector) == pytest.approx(
        rotate_vector(np.array(vector), wxyz), abs=1e-9
    )
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert rotation_from_quaternion(3.0 * np.array(wxyz)) == pytest.approx(rotation, abs=1e-9)


@given(yaw=st.floats(-3.1, 3.1))
def test_yaw_of_rotation_from_yaw_is_unchanged(yaw: float) -> None:
    rotation = rotation_from_quaternion(quaternion_from_yaw(yaw))
    assert yaw_from_rotation(rotation) == pytest.approx(yaw, abs=1e-9)
    assert rotation == pytest.approx(compute_joint_rotation("yaw", yaw), abs=1e-9)
