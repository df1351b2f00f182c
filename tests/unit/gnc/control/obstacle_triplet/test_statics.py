"""Tests the statics of an obstacle triplet.

The forces and torques are compared with closed forms, with balance and invariance, and with the paper's own
equations. Triplets that cannot push are refused.
"""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from snakesim_gnc.control.obstacle_triplet import compute_bending_torque_nm, solve_triplet
from snakesim_gnc.control.obstacle_triplet.statics import add_tether_force
from snakesim_testing.messages import raises_error

PROPULSION_N = 35.0


def compute_cross_product(a, b):
    """Return the z component of the cross products of vectors in the plane."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def make_unit_vector(angle_rad):
    return np.array([np.cos(angle_rad), np.sin(angle_rad)])


@dataclass(frozen=True)
class Triplet:
    """Three contacts and a propulsion joint, all in the world frame."""

    points: np.ndarray  # (3, 2) in m
    normals: np.ndarray  # (3, 2)
    tangent: np.ndarray  # (2,) of the body at the first contact
    joint: np.ndarray  # (2,) in m

    def solve(self, propulsion_n=PROPULSION_N, **options):
        return solve_triplet(
            self.points, self.normals, self.tangent, propulsion_n, self.joint, **options
        )


def make_triplet_at_inflections(slope_rad: float) -> Triplet:
    """Return contacts at the inflections of a sine that rises at the first one."""
    points = np.array([[0.0, 0.0], [0.3, 0.0], [0.6, 0.0]])
    cos = np.cos(slope_rad)
    sin = np.sin(slope_rad)
    normals = np.array([[sin, -cos], [sin, cos], [sin, -cos]])
    return Triplet(points, normals, np.array([cos, sin]), np.array([0.36, 0.02]))


@st.composite
def triplets(draw) -> Triplet:
    """Draw well-conditioned contacts on alternating sides of a body that bends a lot. Their forces have any sign."""
    jitter_m = st.floats(-0.08, 0.08)
    points = np.array([[0.3 * i + draw(jitter_m), draw(jitter_m)] for i in range(3)])
    headings_rad = [draw(st.floats(-0.5, 0.5)) for _ in range(3)]
    first_side = draw(st.sampled_from([-1, 1]))
    normals = np.array(
        [
            make_unit_vector(heading_rad + first_side * (-1) ** i * np.pi / 2)
            for i, heading_rad in enumerate(headings_rad)
        ]
    )
    joint_fraction = draw(st.floats(0.1, 0.8))
    joint = points[1] + joint_fraction * (points[2] - points[1]) + np.array([0.0, draw(jitter_m)])
    triplet = Triplet(points, normals, make_unit_vector(headings_rad[0]), joint)
    assume(triplet.solve().condition < 50)
    return triplet


@pytest.mark.parametrize("slope_deg", [5.0, 15.0, 24.8, 29.0])
def test_statics_of_contacts_at_inflections_equals_closed_form(slope_deg):
    slope_rad = np.radians(slope_deg)
    solved = make_triplet_at_inflections(slope_rad).solve(1.0)
    third_n = 0.5 / np.sin(2 * slope_rad)
    first_n = third_n - np.tan(slope_rad)
    assert solved.forces_n == pytest.approx([first_n, 2 * third_n, third_n], rel=1e-9)


@pytest.mark.parametrize(
    ("slope_deg", "is_feasible"), [(29.9, True), (30.1, False), (40.0, False), (1.0, True)]
)
def test_statics_beyond_30_degrees_is_infeasible_at_tail_contact(slope_deg, is_feasible):
    solved = make_triplet_at_inflections(np.radians(slope_deg)).solve()
    assert solved.is_feasible is is_feasible
    assert ("lambda_1" in solved.reason) is not is_feasible
    assert bool(solved.reason) is not is_feasible


@given(triplets())
def test_statics_forces_and_moments_balance(triplet):
    magnitudes_n = triplet.solve().forces_n
    forces_n = add_tether_force(magnitudes_n, triplet.normals, -PROPULSION_N * triplet.tangent)
    scale_n = np.abs(magnitudes_n).max() + PROPULSION_N
    assert np.abs(forces_n.sum(axis=0)).max() < 1e-9 * scale_n
    assert abs(compute_cross_product(triplet.points, forces_n).sum()) < 1e-9 * scale_n


@given(triplets(), st.floats(-3.1, 3.1), st.floats(-50, 50), st.floats(-50, 50))
def test_statics_does_not_depend_on_the_world_frame(triplet, angle_rad, x, y):
    cos = np.cos(angle_rad)
    sin = np.sin(angle_rad)
    rotation = np.array([[cos, -sin], [sin, cos]])
    shift = np.array([x, y])
    moved_triplet = Triplet(
        triplet.points @ rotation.T + shift,
        triplet.normals @ rotation.T,
        rotation @ triplet.tangent,
        rotation @ triplet.joint + shift,
    )
    solved = triplet.solve()
    moved = moved_triplet.solve()
    assert moved.forces_n == pytest.approx(solved.forces_n, rel=1e-7, abs=1e-7)
    assert moved.torque_nm == pytest.approx(solved.torque_nm, rel=1e-7, abs=1e-7)
    assert moved.condition == pytest.approx(solved.condition, rel=1e-7)


@given(triplets())
def test_statics_of_mirror_image_has_equal_forces_opposite_torque(triplet):
    mirror = np.array([1.0, -1.0])
    mirrored_triplet = Triplet(
        triplet.points * mirror,
        triplet.normals * mirror,
        triplet.tangent * mirror,
        triplet.joint * mirror,
    )
    mirrored = mirrored_triplet.solve()
    solved = triplet.solve()
    assert mirrored.forces_n == pytest.approx(solved.forces_n, rel=1e-9, abs=1e-9)
    assert mirrored.torque_nm == pytest.approx(-solved.torque_nm, rel=1e-9, abs=1e-9)


@given(triplets(), st.floats(0.1, 10), st.floats(0.1, 10))
def test_statics_scales_with_propulsion_and_torque_with_size(triplet, force_scale, size_scale):
    solved = triplet.solve()
    scaled_triplet = Triplet(
        triplet.points * size_scale, triplet.normals, triplet.tangent, triplet.joint * size_scale
    )
    scaled = scaled_triplet.solve(PROPULSION_N * force_scale)
    torque_scale = force_scale * size_scale
    assert scaled.forces_n == pytest.approx(force_scale * solved.forces_n, rel=1e-7, abs=1e-9)
    assert scaled.torque_nm == pytest.approx(torque_scale * solved.torque_nm, rel=1e-7, abs=1e-9)
    assert scaled.condition == pytest.approx(solved.condition, rel=1e-7)


@given(triplets())
def test_statics_agrees_with_corrected_paper_equations(triplet):
    """Solve the paper's equations for lambda_1, lambda_2 and tau.

    Equation (3) is used as f_tau = (r x tau)/|r|^2, and (5) to (9) accordingly.
    """
    o_1, o_2, o_3 = triplet.points
    n_1, n_2, n_3 = triplet.normals
    t_3 = np.array([n_3[1], -n_3[0]])
    r = o_3 - triplet.joint
    assume(abs(r @ t_3) > 0.05 * np.hypot(*r))
    f_tau = np.array([r[1], -r[0]]) / (r @ r)  # (3) for tau = 1: r x tau = (r_y tau, -r_x tau)
    assert compute_cross_product(r, f_tau) == pytest.approx(-1.0)
    along = r / np.hypot(*r)
    f_r = -(f_tau @ t_3) / (along @ t_3)  # (8), from (1) and (6): tau x r = -(r x tau)
    f_3 = f_tau + f_r * along  # (9)
    assert f_3 @ t_3 == pytest.approx(0.0, abs=1e-9)  # (1)
    f_s = -PROPULSION_N * triplet.tangent
    balance = np.array(
        [  # (10), and (11) about the global origin
            [n_1[0], n_2[0], f_3[0]],
            [n_1[1], n_2[1], f_3[1]],
            [
                compute_cross_product(o_1, n_1),
                compute_cross_product(o_2, n_2),
                compute_cross_product(o_3, f_3),
            ],
        ]
    )
    lambda_1, lambda_2, tau = np.linalg.solve(
        balance, -np.array([*f_s, compute_cross_product(o_1, f_s)])
    )
    solved = triplet.solve()
    assert [lambda_1, lambda_2] == pytest.approx(solved.forces_n[:2], rel=1e-6, abs=1e-6)
    assert tau * f_3 == pytest.approx(solved.forces_n[2] * n_3, rel=1e-6, abs=1e-6)
    assert tau == pytest.approx(solved.torque_nm, rel=1e-6, abs=1e-6)


@given(
    triplets(),
    st.lists(st.tuples(st.floats(-0.2, 0.9), st.floats(-0.3, 0.3)), min_size=1, max_size=8),
)
def test_statics_bending_torque_from_head_and_tail_agrees(triplet, joints):
    contacts_s_m = np.array([0.0, 0.3, 0.6])
    solved = triplet.solve()
    forces_n = add_tether_force(solved.forces_n, triplet.normals, -PROPULSION_N * triplet.tangent)
    joints_w = np.array(joints)
    joints_s_m = joints_w[:, 0]
    torques_nm = compute_bending_torque_nm(
        joints_w, joints_s_m, triplet.points, contacts_s_m, forces_n
    )
    for joint_w, joint_s_m, torque_nm in zip(joints_w, joints_s_m, torques_nm, strict=True):
        is_behind = contacts_s_m <= joint_s_m
        moments_nm = compute_cross_product(triplet.points - joint_w, forces_n)
        assert torque_nm == pytest.approx(moments_nm[is_behind].sum(), abs=1e-7)
        assert torque_nm == pytest.approx(-moments_nm[~is_behind].sum(), abs=1e-7)
    (torque_nm,) = compute_bending_torque_nm(
        triplet.joint[None], [0.4], triplet.points, contacts_s_m, forces_n
    )
    assert torque_nm == pytest.approx(solved.torque_nm, rel=1e-9, abs=1e-9)


PARALLEL = make_triplet_at_inflections(1e-9)
TOWARDS_COMMON_POINT = np.array([0.3, 1.0]) - PARALLEL.points
MEETING_NORMALS = TOWARDS_COMMON_POINT / np.linalg.norm(TOWARDS_COMMON_POINT, axis=1)[:, None]
MEETING = replace(PARALLEL, normals=MEETING_NORMALS)


@pytest.mark.parametrize("triplet", [PARALLEL, MEETING], ids=["parallel", "meeting in a point"])
def test_statics_of_parallel_or_meeting_normals_is_ill_conditioned(triplet):
    solved = triplet.solve()
    assert not solved.is_feasible
    assert "ill-conditioned" in solved.reason
    assert solved.condition > 100
    assert np.isnan(solved.forces_n).all()
    assert np.isnan(solved.torque_nm)


def test_statics_conditioning_limit_can_be_set():
    triplet = make_triplet_at_inflections(np.radians(1.0))
    assert triplet.solve(condition_max=1e3).is_feasible
    assert not triplet.solve(condition_max=10).is_feasible


@pytest.mark.parametrize("from_contact_m", [0.1, 0.0])
def test_statics_joint_at_contact_or_third_normal_has_no_authority(from_contact_m):
    triplet = make_triplet_at_inflections(0.3)
    solved = replace(triplet, joint=triplet.points[2] - from_contact_m * triplet.normals[2]).solve()
    assert not solved.is_feasible
    assert "no authority" in solved.reason
    assert np.isfinite(solved.forces_n).all()


def test_statics_of_coinciding_contacts_is_refused():
    triplet = make_triplet_at_inflections(0.3)
    assert "same point" in replace(triplet, points=triplet.points[[0, 1, 0]]).solve().reason


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("points_w", [[0, 0], [0.3, np.nan], [0.6, 0]]),
        ("points_w", [[0, 0], [0.3, 0]]),
        ("normals_w", [[0, 2.0], [0, -1], [0, 1]]),
        ("normals_w", [[0, 0.0], [0, -1], [0, 1]]),
        ("tangent_1_w", [1.0, 1.0]),
        ("tangent_1_w", [np.inf, 0.0]),
        ("joint_w", [0.4]),
        *(("propulsion_n", no_push) for no_push in (0.0, -1.0, np.nan, np.inf)),
    ],
)
def test_statics_with_invalid_arguments_is_an_error(name, value):
    triplet = make_triplet_at_inflections(0.3)
    arguments = {
        "points_w": triplet.points,
        "normals_w": triplet.normals,
        "tangent_1_w": triplet.tangent,
        "propulsion_n": 35.0,
        "joint_w": triplet.joint,
    }
    with raises_error(ValueError):
        solve_triplet(**{**arguments, name: value})
