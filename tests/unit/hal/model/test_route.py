"""Routes by arc length, projection onto routes, and chains that are placed on them."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.route import (
    Route,
    compute_yaw_segments_m,
    expand_yaw_angles,
    find_arc_length_at_distance,
    place_chain_on_route,
    sample_sine_curve,
)
from snakesim_testing.hypothesis_profiles import choose_trial_count
from snakesim_testing.messages import raises_error


@st.composite
def draw_gentle_route(draw: st.DrawFn) -> Route:
    """Draw a sine route that a snake can follow."""
    wavelength_m = draw(st.floats(0.5, 3.0))
    amplitude_m = draw(st.floats(0.0, 0.15)) * wavelength_m
    return Route(sample_sine_curve(amplitude_m, wavelength_m, draw(st.floats(2.0, 6.0))))


def make_arc(radius_m: float, turn_rad: float, count: int = 2000) -> Route:
    """Return a circular arc that begins at the origin along x."""
    angle = np.linspace(0, turn_rad, count)
    return Route(radius_m * np.column_stack([np.sin(angle), 1 - np.cos(angle)]))


def test_route_length_of_known_curves_is_exact() -> None:
    assert Route([(0, 0), (3, 4), (3, 5)]).length_m == pytest.approx(6.0)
    assert make_arc(0.7, 3.0).length_m == pytest.approx(2.1, rel=1e-5)
    x = np.linspace(0, 4, 400_001)
    slope = 0.1 * (2 * np.pi / 0.8) * np.cos(2 * np.pi * x / 0.8)
    exact = float(np.trapezoid(np.hypot(1.0, slope), x))
    assert Route(sample_sine_curve(0.1, 0.8, 4.0)).length_m == pytest.approx(exact, rel=1e-3)


def test_route_passes_through_points_and_extends_straight_at_ends() -> None:
    route = Route([(0, 0), (3, 4), (3, 5)])
    expected_points = {
        -5.0: (-3, -4),
        0.0: (0, 0),
        2.5: (1.5, 2),
        5.0: (3, 4),
        5.5: (3, 4.5),
        6.0: (3, 5),
        8.0: (3, 7),
    }
    assert route.compute_positions_w(np.array(list(expected_points))) == pytest.approx(
        np.array(list(expected_points.values()))
    )


@given(route=draw_gentle_route(), s_m=st.floats(-1, 8))
def test_route_fast_lookup_equals_the_slow_one(route: Route, s_m: float) -> None:
    assert route.compute_point(s_m) == pytest.approx(
        tuple(route.compute_positions_w(s_m)), abs=1e-9
    )


@given(route=draw_gentle_route(), s_m=st.floats(-0.5, 7), step_m=st.floats(1e-4, 0.05))
def test_route_chord_is_at_most_and_nearly_its_arc(route: Route, s_m: float, step_m: float) -> None:
    chord = math.dist(route.compute_point(s_m), route.compute_point(s_m + step_m))
    assert 0.9 * step_m <= chord <= step_m * (1 + 1e-9)


def test_route_heading_of_a_circle_grows_linearly() -> None:
    route = make_arc(0.7, 3.0)
    for s_m in (0.1, 1.0, 2.0):
        assert route.compute_heading_rad(s_m) == pytest.approx(s_m / 0.7, abs=1e-3)
        assert route.tangent_w(s_m) == pytest.approx(
            [math.cos(s_m / 0.7), math.sin(s_m / 0.7)], abs=1e-3
        )


# --- projection ------------------------------------------------------------------------------------------------


@given(route=draw_gentle_route(), x=st.floats(-0.3, 6), y=st.floats(-0.6, 0.6))
@settings(max_examples=choose_trial_count(60))
def test_projection_onto_route_is_the_nearest_point(route: Route, x: float, y: float) -> None:
    s_m = route.project_point(np.array([x, y]))
    distance_m = math.dist(route.compute_point(s_m), (x, y))
    samples_w = route.compute_positions_w(np.arange(-1.0, route.length_m + 1.0, 0.004))
    assert distance_m <= float(np.hypot(*(samples_w - [x, y]).T).min()) + 1e-9


def project_by_measuring_all(route: Route, point_w: Floats, first: int, last: int) -> float:
    """Project onto every segment from `first` to before `last`.

    Returns:
        What `Route.project_point` must return, bit for bit.
    """
    lengths = np.hypot(*np.diff(route.points_w, axis=0).T)
    s_m = np.concatenate(([0.0], np.cumsum(lengths)))
    starts = route.points_w[first:last]
    directions = np.diff(route.points_w, axis=0)[first:last] / lengths[first:last, None]
    along = np.einsum("ij,ij->i", point_w - starts, directions)
    low = np.zeros(last - first)
    high = np.diff(s_m[first : last + 1])
    if first == 0:
        low[0] = -np.inf
    if last == len(lengths):
        high[-1] = np.inf
    along = np.clip(along, low, high)
    gaps = starts + along[:, None] * directions - point_w
    nearest = int(np.argmin(np.einsum("ij,ij->i", gaps, gaps)))
    return float(s_m[first + nearest] + along[nearest])


@given(
    seed=st.integers(0, 2**31),
    count=st.sampled_from([1, 2, 5, 17, 300]),
    spread_m=st.sampled_from([0.02, 1.0, 50.0]),
)
def test_projection_is_bit_identical_to_measuring_every_segment(
    seed: int, count: int, spread_m: float
) -> None:
    """Compare on random walks that cross themselves, for points on them and far away, with and without a window."""
    random = np.random.default_rng(seed)
    headings_rad = np.cumsum(random.normal(0.0, random.choice([0.05, 1.0]), count))
    steps = random.uniform(0.002, 0.05, count)[:, None] * np.column_stack(
        [np.cos(headings_rad), np.sin(headings_rad)]
    )
    route = Route(np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]))
    for _ in range(8):
        vertex_w = route.points_w[random.integers(len(route.points_w))]
        point_w = vertex_w + random.normal(0.0, spread_m, 2) * random.integers(2)
        assert route.project_point(point_w) == project_by_measuring_all(route, point_w, 0, count)
        near_s_m = float(random.uniform(-1.0, route.length_m + 1.0))
        first, last = route._find_segments_near(near_s_m, 0.3)
        assert route.project_point(point_w, near_s_m, 0.3) == project_by_measuring_all(
            route, point_w, first, last
        )


def test_projection_near_a_place_stays_on_its_branch() -> None:
    """Project in a hairpin, where the nearest point of all is on the other leg."""
    route = Route([(0, 0), (2, 0), (2, 0.2), (0, 0.2)])
    point = np.array([0.5, 0.19])
    assert route.project_point(point) == pytest.approx(3.7)
    assert route.project_point(point, near_s_m=0.5) == pytest.approx(0.5)
    for near_s_m in (-50.0, 50.0):  # far beyond both ends
        assert math.isfinite(route.project_point(point, near_s_m=near_s_m))


@given(route=draw_gentle_route(), s_m=st.floats(0, 5), offset_m=st.floats(-0.3, 0.3))
def test_projection_near_the_right_place_is_exact(
    route: Route, s_m: float, offset_m: float
) -> None:
    point = np.array(route.compute_point(s_m))
    assert (
        math.dist(route.compute_point(route.project_point(point, near_s_m=s_m + offset_m)), point)
        < 1e-7
    )


# --- inflections -----------------------------------------------------------------------------------------------


def test_route_inflections_of_sine_are_at_half_waves() -> None:
    route = Route(sample_sine_curve(0.1, 0.8, 4.0))
    inflections_w = route.compute_positions_w(np.array(route.find_inflections_s_m()))
    assert inflections_w[:, 0] == pytest.approx(0.4 * np.arange(1, 10), abs=0.011)
    assert np.abs(inflections_w[:, 1]).max() < 0.01


def test_route_inflections_are_detected_across_straight_pieces_only() -> None:
    arc_angles_rad = np.linspace(0, 1, 50)
    first_arc = np.column_stack([np.sin(arc_angles_rad), 1 - np.cos(arc_angles_rad)])
    forward = np.array([math.cos(1.0), math.sin(1.0)])
    straight = first_arc[-1] + np.linspace(0.05, 1, 20)[:, None] * forward
    mirrored_arc = straight[-1] + first_arc[-1] - first_arc[::-1]
    route = Route(np.vstack([first_arc, straight, mirrored_arc[1:]]))
    (inflection_s_m,) = route.find_inflections_s_m()
    assert 1.0 < inflection_s_m < 2.0
    assert make_arc(1.0, 2.0).find_inflections_s_m() == []
    assert Route([(0, 0), (1, 0)]).find_inflections_s_m() == []
    assert Route([(0, 0), (1, 0), (2, 0), (3, 0)]).find_inflections_s_m() == []


@pytest.mark.parametrize("points", [[(0, 0)], [(0, 0), (0, 0)], [(0, 0), (1, 0), (1, 0), (2, 0)]])
def test_route_with_repeated_or_too_few_points_is_refused(
    points: list[tuple[float, float]],
) -> None:
    with raises_error(ValueError):
        Route(points)


def test_sine_curve_begins_at_origin_and_has_its_length() -> None:
    points = sample_sine_curve(0.1, 0.8, 1.23)
    assert points[0].tolist() == [0.0, 0.0]
    assert points[-1][0] == pytest.approx(1.23)
    assert np.diff(points[:, 0]).max() <= 0.01 + 1e-12
    assert len(sample_sine_curve(0.1, 0.8, 0.001)) == 2


# --- chains ----------------------------------------------------------------------------------------------------


def compute_nodes(
    tail_w: tuple[float, float], heading_rad: float, angles_rad: Floats, lengths_m: list[float]
) -> Floats:
    """Return tail, joints and head of a planar chain, from the sums of its angles."""
    headings = heading_rad + np.concatenate([[0.0], np.cumsum(angles_rad)])
    steps = np.array(lengths_m)[:, None] * np.column_stack([np.cos(headings), np.sin(headings)])
    return np.vstack([tail_w, tail_w + np.cumsum(steps, axis=0)])


@given(
    route=draw_gentle_route(),
    tail_s_m=st.floats(-0.5, 2.0),
    lengths_m=st.lists(st.floats(0.04, 0.15), min_size=2, max_size=15),
)
def test_route_placed_chain_has_joints_at_their_distances(
    route: Route, tail_s_m: float, lengths_m: list[float]
) -> None:
    placement = place_chain_on_route(route, tail_s_m, lengths_m)
    points = compute_nodes(placement.tail_w, placement.heading_rad, placement.angles_rad, lengths_m)
    assert placement.tail_w == pytest.approx(route.compute_point(tail_s_m))
    assert len(placement.angles_rad) == len(lengths_m) - 1
    assert np.abs(placement.angles_rad).max() <= math.pi
    arc_lengths_m = [
        route.project_point(point, near_s_m=tail_s_m + sum(lengths_m[:i]))
        for i, point in enumerate(points)
    ]
    assert (
        max(
            math.dist(route.compute_point(s_m), point_w)
            for s_m, point_w in zip(arc_lengths_m, points, strict=True)
        )
        < 1e-5
    )
    assert np.diff(arc_lengths_m).min() > 0  # from tail to head, in the direction of travel


def test_route_placed_chain_bends_like_the_route() -> None:
    placement = place_chain_on_route(make_arc(1.0, 3.0), 0.2, [0.1] * 10)
    assert placement.angles_rad == pytest.approx([2 * math.asin(0.05)] * 9, rel=1e-3)
    straight = place_chain_on_route(Route([(0, 0), (0, 5)]), 1.0, [0.1] * 5)
    assert straight.heading_rad == pytest.approx(math.pi / 2)
    assert np.abs(straight.angles_rad).max() < 1e-9
    # The headings cross half a revolution, and no joint angle changes by 2 pi.
    backwards = place_chain_on_route(make_arc(1.0, 6.0), 2.8, [0.2] * 5)
    assert backwards.angles_rad == pytest.approx([2 * math.asin(0.1)] * 4, rel=1e-3)


@given(route=draw_gentle_route(), s_m=st.floats(0, 4), distance_m=st.floats(0.01, 0.2))
def test_route_next_point_is_at_the_straight_distance(
    route: Route, s_m: float, distance_m: float
) -> None:
    next_s_m = find_arc_length_at_distance(route, route.compute_point(s_m), s_m, distance_m)
    assert next_s_m >= s_m + distance_m - 1e-6
    assert math.dist(route.compute_point(next_s_m), route.compute_point(s_m)) == pytest.approx(
        distance_m, abs=1e-6
    )


@given(axes=st.lists(st.sampled_from(["yaw", "pitch"]), min_size=1, max_size=12))
def test_route_yaw_segments_of_mixed_axes_are_longer(axes: list[str]) -> None:
    lengths = [0.05] + [0.1] * (len(axes) - 1) + [0.05]
    segments = compute_yaw_segments_m(axes, lengths)
    assert len(segments) == axes.count("yaw") + 1
    assert sum(segments) == pytest.approx(sum(lengths))
    yaw_angles = np.arange(1.0, axes.count("yaw") + 1)
    angles = expand_yaw_angles(axes, yaw_angles)
    assert [
        angle for angle, axis in zip(angles, axes, strict=True) if axis == "yaw"
    ] == yaw_angles.tolist()
    assert all(angle == 0 for angle, axis in zip(angles, axes, strict=True) if axis == "pitch")
