"""Tests that the path search in C gives the grids and paths of its specification in Python, to the last bit."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from snakesim_gnc.geometry.planar import resample_evenly
from snakesim_gnc.navigation.obstacle_grid import ObstacleGrid
from snakesim_gnc.navigation.path_search.beam import BeamSearch, PathSearchSteps
from snakesim_gnc.navigation.path_search.native_growth import NativeExpander
from snakesim_gnc.navigation.path_search.native_library import (
    PlannerLibraryError,
    is_native_available,
    load_library,
)
from snakesim_gnc.navigation.path_search.search_nodes import NodeLayer, make_start_nodes
from snakesim_gnc.navigation.path_search.search_parameters import SearchParameters
from snakesim_gnc.navigation.path_search.search_task import SearchedPath, SearchTask
from snakesim_gnc.navigation.path_search.specified_growth import NumpyExpander
from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import KnownObstacle
from snakesim_native import load

BODY_M = 1.0
BODY_ARCS = 20
SEARCH = SearchParameters(
    body_length_m=BODY_M,
    radius_m=0.04,
    segment_m=0.11,
    kept_nodes=60,
    unused_tail_m=0.05,
    unused_head_m=0.05,
)
needs_library = pytest.mark.skipif(
    not is_native_available(), reason="the C library cannot be compiled here"
)


def make_body(random: np.random.Generator) -> Floats:
    """Return a curve (n, 2) that undulates along x, from tail to head, and ends at the origin."""
    x = np.linspace(-0.9, 0.0, 91)
    y = random.uniform(0.0, 0.08) * np.sin(2 * np.pi * x / 0.8 + random.uniform(0.0, 6.0))
    return resample_evenly(np.column_stack([x, y - y[-1]]))


def make_obstacles(random: np.random.Generator, body_w: Floats) -> list[KnownObstacle]:
    """Return cylinders and turned boxes on an irregular lattice, some of which touch the body's sides."""
    spacing_m = random.uniform(0.18, 0.35)
    columns = np.arange(-1.2, 1.8, spacing_m)
    rows = np.arange(-0.8, 0.8, spacing_m)
    obstacles: list[KnownObstacle] = []
    for x, y in np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2) + random.uniform(
        0.0, 0.1, 2
    ):
        place_w = np.array([x, y]) + random.uniform(-0.2, 0.2, 2) * spacing_m
        radius_m = float(random.uniform(0.02, 0.05))
        if np.hypot(*(body_w - place_w).T).min() < 1.3 * radius_m + 0.045:
            continue
        obstacle = KnownObstacle(
            name=f"obstacle{len(obstacles)}",
            shape="box" if random.random() < 0.4 else "cylinder",
            position_w=(float(place_w[0]), float(place_w[1]), 0.1),
            radius_m=radius_m,
            half_size_m=(radius_m, 0.7 * radius_m, 0.1),
            yaw_rad=float(random.uniform(-3.0, 3.0)),
            height_m=0.2,
        )
        obstacles.append(obstacle)
    return obstacles


def finish_search(search: PathSearchSteps) -> tuple[list[int], SearchedPath | None]:
    """Return the nodes of each step of a search, and its path."""
    nodes: list[int] = []
    while True:
        try:
            nodes.append(next(search))
        except StopIteration as done:
            return nodes, done.value


def assert_equal_bits(
    first: tuple[list[int], SearchedPath | None], second: tuple[list[int], SearchedPath | None]
) -> None:
    assert first[0] == second[0]
    first_path, second_path = first[1], second[1]
    if first_path is None or second_path is None:
        assert first_path is second_path
        return
    assert first_path.points_w.tobytes() == second_path.points_w.tobytes()
    assert first_path.margins_n.tobytes() == second_path.margins_n.tobytes()
    assert first_path.cost_m == second_path.cost_m


@needs_library
@pytest.mark.parametrize(
    "seed", [*range(4), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(4, 12))]
)
@pytest.mark.parametrize("kind", ["ahead", "whole body", "whole body beside failed paths"])
def test_native_paths_equal_those_of_the_specification_to_the_bit(kind: str, seed: int) -> None:
    random = np.random.default_rng(seed)
    body_w = make_body(random)
    obstacles = make_obstacles(random, body_w)
    parameters = replace(
        SEARCH,
        kept_nodes=int(random.choice([20, 60, 150])),
        kept_per_wide_cell=int(random.choice([1, 6])),
        assumed_obstacle_friction=float(random.choice([0.0, 0.3])),
    )
    goal_rad = float(random.uniform(-1.2, 1.2))
    failed_w = np.concatenate([body_w[::3] + random.normal(0.0, 0.02, 2) for _ in range(3)])
    results: list[tuple[list[int], SearchedPath | None]] = []
    for growth in (NumpyExpander, NativeExpander):
        beam = BeamSearch(ObstacleGrid(obstacles), parameters, growth)
        if kind == "ahead":
            search = beam.search_ahead(body_w, goal_rad, 30)
        elif kind == "whole body":
            search = beam.search_whole_body(body_w, goal_rad, 15, 0.07)
        else:
            search = beam.search_whole_body(body_w, goal_rad, 15, 0.07, failed_w)
        results.append(finish_search(search))
    assert_equal_bits(results[0], results[1])


@needs_library
@pytest.mark.parametrize("kept_nodes", [2, 7, 20])
def test_native_search_keeps_the_same_of_equal_paths(kept_nodes: int) -> None:
    """Without obstacles, progress and curvature in the cost, all paths cost the same."""
    body_w = np.column_stack([np.linspace(-1.0, 0.0, 101), np.zeros(101)])
    parameters = replace(
        SEARCH, kept_nodes=kept_nodes, progress_reward=0.0, curvature_change_cost_m=0.0
    )
    results = [
        finish_search(
            BeamSearch(ObstacleGrid([]), parameters, growth).search_ahead(body_w, 0.3, 10)
        )
        for growth in (NumpyExpander, NativeExpander)
    ]
    assert_equal_bits(results[0], results[1])


@needs_library
def test_random_scenes_lead_to_all_kinds_of_paths() -> None:
    """The comparison needs paths that are long, end early, push, and cannot push."""
    paths: list[SearchedPath] = []
    for seed in range(12):
        random = np.random.default_rng(seed)
        body_w = make_body(random)
        obstacles = make_obstacles(random, body_w)
        _, path = finish_search(
            BeamSearch(ObstacleGrid(obstacles), SEARCH).search_ahead(body_w, 0.0, 30)
        )
        if path is not None:
            paths.append(path)
    assert max(len(path.points_w) for path in paths) == 31
    margins_n = np.concatenate([path.margins_n for path in paths])
    assert (margins_n == 0.0).any()
    assert (margins_n > SEARCH.wanted_margin_n).any()
    assert ((margins_n > 0.0) & (margins_n < SEARCH.wanted_margin_n)).any()


def make_task(initial_drag_m: Floats) -> SearchTask:
    return SearchTask(
        origin_w=np.zeros(2),
        travel_direction_rad=0.0,
        travel_direction_w=np.array([1.0, 0.0]),
        initial_drag_m=initial_drag_m,
    )


def make_start_layer() -> NodeLayer:
    return make_start_nodes(np.zeros((1, 2)), np.zeros(1))


@needs_library
def test_native_expander_names_an_array_of_wrong_size() -> None:
    task = make_task(initial_drag_m=np.zeros((BODY_ARCS - 1, 3)))
    message = r"the drag of the lying body has the shape \(19, 3\), the C library of the planner expects \(20, 3\)"
    with pytest.raises(PlannerLibraryError, match=message):
        NativeExpander(ObstacleGrid([]), SEARCH, task, make_start_layer(), max_arc_count=5)


@needs_library
def test_native_expander_refuses_more_layers_than_allocated() -> None:
    task = make_task(initial_drag_m=np.zeros((BODY_ARCS, 3)))
    paths = NativeExpander(ObstacleGrid([]), SEARCH, task, make_start_layer(), max_arc_count=2)
    assert paths.trace_cheapest() is None
    assert paths.expand_layer()
    assert paths.expand_layer()
    with pytest.raises(PlannerLibraryError, match="have 2 arcs already"):
        paths.expand_layer()
    path = paths.trace_cheapest()
    assert path is not None
    assert len(path.points_w) == 3


@pytest.fixture
def no_library(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Switch the C libraries off."""
    monkeypatch.setenv(load.SWITCH_VARIABLE, load.SWITCH_OFF)
    load_library.cache_clear()
    yield
    load_library.cache_clear()


@needs_library
def test_obstacle_grid_is_the_same_without_the_library(
    request: pytest.FixtureRequest,
) -> None:
    random = np.random.default_rng(5)
    obstacles = make_obstacles(random, make_body(random))
    native = ObstacleGrid(obstacles)
    request.getfixturevalue("no_library")
    specified = ObstacleGrid(obstacles)
    assert native.nearest_obstacle_by_cell.tobytes() == specified.nearest_obstacle_by_cell.tobytes()
    assert native.cell_distance_m.tobytes() == specified.cell_distance_m.tobytes()
    assert len(np.unique(native.nearest_obstacle_by_cell)) > len(obstacles) // 2


@pytest.mark.usefixtures("no_library")
def test_path_search_without_the_library_uses_the_specification() -> None:
    assert not is_native_available()
    body_w = make_body(np.random.default_rng(0))
    nodes, path = finish_search(BeamSearch(ObstacleGrid([]), SEARCH).search_ahead(body_w, 0.0, 3))
    assert nodes[0] == 1
    assert path is not None
    task = make_task(initial_drag_m=np.zeros((BODY_ARCS, 3)))
    with pytest.raises(PlannerLibraryError, match="SNAKESIM_NATIVE"):
        NativeExpander(ObstacleGrid([]), SEARCH, task, make_start_layer(), max_arc_count=2)
