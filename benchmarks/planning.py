"""What the path search costs, in C and in Python: paths through random fields of obstacles."""

import statistics
import time

from snakesim_gnc.geometry.body_on_path import compute_chain_points
from snakesim_gnc.geometry.planar import resample_evenly
from snakesim_gnc.navigation.obstacle_grid import ObstacleGrid
from snakesim_gnc.navigation.path_search.beam import BeamSearch
from snakesim_gnc.navigation.path_search.native_growth import NativeExpander
from snakesim_gnc.navigation.path_search.native_library import is_native_available
from snakesim_gnc.navigation.path_search.search_parameters import STEP_M, SearchParameters
from snakesim_gnc.navigation.path_search.specified_growth import NumpyExpander
from snakesim_gnc.navigation.plan import HORIZON_M
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.route import compute_yaw_segments_m
from snakesim_hal.model.scenario import (
    compute_start_pose,
    load_scenario,
    parse_set_option,
    place_obstacles,
)

SEEDS = (1, 2, 3, 4, 5)  # of the fields
SEARCH = SearchParameters(body_length_m=1.54, radius_m=0.04, segment_m=0.11)  # planar13


class PlanningCosts:
    """Searches the same paths in C and in Python."""

    def __init__(self) -> None:
        """Lay out the fields."""
        self._scenes = [_make_scene(seed) for seed in SEEDS]

    def measure_kilonode_us(self) -> tuple[list[float], list[float]]:
        """Return the CPU time for 1000 nodes in µs, in C and in Python, one for each field.

        Raises:
            RuntimeError: the C library cannot be loaded here.
        """
        if not is_native_available():
            raise RuntimeError(
                "the C library of the planner cannot be loaded: run `python -m snakesim_native.compile`"
            )
        native_us: list[float] = []
        python_us: list[float] = []
        for grid, body_w in self._scenes:
            native_us.append(_measure_search_us(BeamSearch(grid, SEARCH, NativeExpander), body_w))
            python_us.append(_measure_search_us(BeamSearch(grid, SEARCH, NumpyExpander), body_w))
        return native_us, python_us


def format_rates(native_us: list[float], python_us: list[float]) -> str:
    """Return a sentence with the nodes per second, from times for 1000 nodes."""
    native_per_s = 1e9 / statistics.median(native_us)
    python_per_s = 1e9 / statistics.median(python_us)
    return f"The path search expands {native_per_s:,.0f} nodes/s on one core, and {python_per_s:,.0f} without C."


def _make_scene(seed: int) -> tuple[ObstacleGrid, Floats]:
    """Return the map of a random field, and the body (n, 2) before it."""
    config = load_scenario(
        "surveyed_clutter", [parse_set_option(f"scene.random_field.0.seed={seed}")]
    ).config
    start = compute_start_pose(config)
    segments_m = compute_yaw_segments_m(config.robot.axes, config.robot.link_lengths_m)
    nodes_w = compute_chain_points(
        start.position_w, start.yaw_rad, start.angles_rad.tolist(), segments_m
    )
    obstacles = [placed.obstacle for placed in place_obstacles(config)]
    return ObstacleGrid(obstacles), resample_evenly(nodes_w.T)


def _measure_search_us(beam: BeamSearch, body_w: Floats) -> float:
    """Return the CPU time of a whole search for 1000 of its nodes."""
    began_s = time.thread_time()
    node_count = sum(beam.search_ahead(body_w, 0.0, round(HORIZON_M / STEP_M)))
    return (time.thread_time() - began_s) / node_count * 1e9
