"""The obstacle triplet's statics: closed forms, balance, invariance, refusals, and the paper's own equations."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from snakesim_gnc.control.obstacle_triplet import compute_bending_torque_nm, solve_triplet
from snakesim_gnc.control.obstacle_triplet.statics import add_tether_force
from snakesim_testing.messages import raises_error

PROPULSION_N = 35.0


def cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def unit(angle_rad):
    return np.array([np.cos(angle_rad), np.sin(angle_rad)])


@dataclass(frozen=True)
class Case:
    points: np.ndarray
    normals: np.ndarray
    tangent: np.ndarray
    joint: np.ndarray

    def solve(self, propulsion_n=PROPULSION_N, **more):
        return solve_triplet(
            self.points, self.normals, self.tangent, propulsion_n, self.joint, **more
        )


def at_inflections(slope_rad: float) -> Case:
    """Contacts at the inflections of a sine that rises at the first one."""
    points = np.array([[0.0, 0.0], [0.3, 0.0], [0.6, 0.0]])
    c, s = np.cos(slope_rad), np.sin(slope_rad)
    normals = np.array([[s, -c], [s, c], [s, -c]])
    return Case(points, normals, np.array([c, s]), np.array([0.36, 0.02]))


@st.composite
def cases(draw) -> Case:
    """Three contacts on alternating sides of a body that bends a lot; well conditioned, of either sign."""
    jitter = st.floats(-0.08, 0.08)
    points = np.array([[0.3 * i + draw(jitter), draw(jitter)] for i in range(3)])
    headings = [draw(st.floats(-0.5, 0.5)) for _ in range(3)]
    first = draw(st.sampled_from([-1, 1]))
    normals = np.array([unit(h + first * (-1) ** i * np.pi / 2) for i, h in enumerate(headings)])
    joint = (
        points[1]
        + draw(st.floats(0.1, 0.8)) * (points[2] - points[1])
        + np.array([0.0, draw(jitter)])
    )
    case = Case(points, normals, unit(headings[0]), joint)
    assume(case.solve().condition < 50)
    return case


@pytest.mark.parametrize("slope_deg", [5.0, 15.0, 24.8, 29.0])
def test_contacts_at_inflections_have_a_closed_form(slope_deg):
    a = np.radians(slope_deg)
    solved = at_inflections(a).solve(1.0)
    third = 0.5 / np.sin(2 * a)
    assert solved.forces_n == pytest.approx([third - np.tan(a), 2 * third, third], rel=1e-9)


@pytest.mark.parametrize(
    ("slope_deg", "feasible"), [(29.9, True), (30.1, False), (40.0, False), (1.0, True)]
)
def test_beyond_30_degrees_the_tail_contact_would_have_to_pull(slope_deg, feasible):
    solved = at_inflections(np.radians(slope_deg)).solve()
    assert solved.is_feasible is feasible
    assert ("lambda_1" in solved.reason) is not feasible
    assert bool(solved.reason) is not feasible


@given(cases())
def test_forces_and_moments_balance(case):
    forces = case.solve().forces_n
    pushed = add_tether_force(forces, case.normals, -PROPULSION_N * case.tangent)
    size = np.abs(forces).max() + PROPULSION_N
    assert np.abs(pushed.sum(axis=0)).max() < 1e-9 * size
    assert abs(cross(case.points, pushed).sum()) < 1e-9 * size


@given(cases(), st.floats(-3.1, 3.1), st.floats(-50, 50), st.floats(-50, 50))
def test_nothing_depends_on_where_the_world_is(case, turn, x, y):
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s], [s, c]])
    shift = np.array([x, y])
    moved = Case(
        case.points @ rotation.T + shift,
        case.normals @ rotation.T,
        rotation @ case.tangent,
        rotation @ case.joint + shift,
    )
    here, there = case.solve(), moved.solve()
    assert there.forces_n == pytest.approx(here.forces_n, rel=1e-7, abs=1e-7)
    assert there.torque_nm == pytest.approx(here.torque_nm, rel=1e-7, abs=1e-7)
    assert there.condition == pytest.approx(here.condition, rel=1e-7)


@given(cases())
def test_statics_of_mirror_image_has_equal_forces_opposite_torque(case):
    mirror = np.array([1.0, -1.0])
    mirrored = Case(
        case.points * mirror, case.normals * mirror, case.tangent * mirror, case.joint * mirror
    ).solve()
    solved = case.solve()
    assert mirrored.forces_n == pytest.approx(solved.forces_n, rel=1e-9, abs=1e-9)
    assert mirrored.torque_nm == pytest.approx(-solved.torque_nm, rel=1e-9, abs=1e-9)


@given(cases(), st.floats(0.1, 10), st.floats(0.1, 10))
def test_forces_scale_with_propulsion_and_torque_also_with_size(case, force, size):
    solved = case.solve()
    scaled = Case(case.points * size, case.normals, case.tangent, case.joint * size).solve(
        PROPULSION_N * force
    )
    assert scaled.forces_n == pytest.approx(force * solved.forces_n, rel=1e-7, abs=1e-9)
    assert scaled.torque_nm == pytest.approx(force * size * solved.torque_nm, rel=1e-7, abs=1e-9)
    assert scaled.condition == pytest.approx(solved.condition, rel=1e-7)


@given(cases())
def test_statics_agrees_with_corrected_paper_equations(case):
    """Equation (3) is used as f_tau = (r x tau)/|r|^2, and (5)-(9) accordingly; unknown are lambda_1, lambda_2, tau."""
    o_1, o_2, o_3 = case.points
    n_1, n_2, n_3 = case.normals
    t_3 = np.array([n_3[1], -n_3[0]])
    r = o_3 - case.joint
    assume(abs(r @ t_3) > 0.05 * np.hypot(*r))
    f_tau = np.array([r[1], -r[0]]) / (r @ r)  # (3) for tau = 1: r x tau = (r_y tau, -r_x tau)
    assert cross(r, f_tau) == pytest.approx(-1.0)
    along = r / np.hypot(*r)
    f_r = -(f_tau @ t_3) / (along @ t_3)  # (8), from (1) and (6): tau x r = -(r x tau)
    f_3 = f_tau + f_r * along  # (9)
    assert f_3 @ t_3 == pytest.approx(0.0, abs=1e-9)  # (1)
    f_s = -PROPULSION_N * case.tangent
    balance = np.array(
        [  # (10), and (11) about the global origin
            [n_1[0], n_2[0], f_3[0]],
            [n_1[1], n_2[1], f_3[1]],
            [cross(o_1, n_1), cross(o_2, n_2), cross(o_3, f_3)],
        ]
    )
    lambda_1, lambda_2, tau = np.linalg.solve(balance, -np.array([*f_s, cross(o_1, f_s)]))
    solved = case.solve()
    assert [lambda_1, lambda_2] == pytest.approx(solved.forces_n[:2], rel=1e-6, abs=1e-6)
    assert tau * f_3 == pytest.approx(solved.forces_n[2] * n_3, rel=1e-6, abs=1e-6)
    assert tau == pytest.approx(solved.torque_nm, rel=1e-6, abs=1e-6)


@given(
    cases(), st.lists(st.tuples(st.floats(-0.2, 0.9), st.floats(-0.3, 0.3)), min_size=1, max_size=8)
)
def test_statics_bending_torque_from_head_and_tail_agrees(case, joints):
    places = np.array([0.0, 0.3, 0.6])
    solved = case.solve()
    pushed = add_tether_force(solved.forces_n, case.normals, -PROPULSION_N * case.tangent)
    joints_w = np.array(joints)
    joints_s = joints_w[:, 0]
    ahead = compute_bending_torque_nm(joints_w, joints_s, case.points, places, pushed)
    for joint_w, joint_s, torque in zip(joints_w, joints_s, ahead, strict=True):
        behind = places <= joint_s
        moments = cross(case.points - joint_w, pushed)
        assert torque == pytest.approx(moments[behind].sum(), abs=1e-7)
        assert torque == pytest.approx(-moments[~behind].sum(), abs=1e-7)
    (torque,) = compute_bending_torque_nm(case.joint[None], [0.4], case.points, places, pushed)
    assert torque == pytest.approx(solved.torque_nm, rel=1e-9, abs=1e-9)


PARALLEL = at_inflections(1e-9)
TO_A_POINT = np.array([0.3, 1.0]) - PARALLEL.points
MEETING = replace(PARALLEL, normals=TO_A_POINT / np.linalg.norm(TO_A_POINT, axis=1)[:, None])


@pytest.mark.parametrize("case", [PARALLEL, MEETING], ids=["parallel", "meeting in a point"])
def test_normals_that_decide_nothing_are_refused_as_ill_conditioned(case):
    solved = case.solve()
    assert not solved.is_feasible
    assert "ill-conditioned" in solved.reason
    assert solved.condition > 100
    assert np.isnan(solved.forces_n).all()
    assert np.isnan(solved.torque_nm)


def test_statics_conditioning_limit_can_be_set():
    case = at_inflections(np.radians(1.0))
    assert case.solve(condition_max=1e3).is_feasible
    assert not case.solve(condition_max=10).is_feasible


@pytest.mark.parametrize("from_contact_m", [0.1, 0.0])
def test_statics_joint_at_contact_or_third_normal_has_no_authority(from_contact_m):
    case = at_inflections(0.3)
    solved = replace(case, joint=case.points[2] - from_contact_m * case.normals[2]).solve()
    assert not solved.is_feasible
    assert "no authority" in solved.reason
    assert np.isfinite(solved.forces_n).all()


def test_coinciding_contacts_are_refused():
    case = at_inflections(0.3)
    assert "same point" in replace(case, points=case.points[[0, 1, 0]]).solve().reason


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
def test_statics_without_three_contacts_is_an_error(name, value):
    case = at_inflections(0.3)
    arguments = {
        "points_w": case.points,
        "normals_w": case.normals,
        "tangent_1_w": case.tangent,
        "propulsion_n": 35.0,
        "joint_w": case.joint,
    }
    with raises_error(ValueError):
        solve_triplet(**{**arguments, name: value})
