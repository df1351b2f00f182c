"""With `map = "perceived"` guidance knows nothing of the scene's obstacles: the file may lie, and changes nothing."""

from typing import ClassVar

import msgspec
import numpy as np
import pytest

from snakesim_gnc.guidance.service import GuidanceService
from snakesim_hal.model.geometry.outlines import compute_outline_distance_m
from snakesim_hal.model.plugins import SERVICES, register_plugin_temporarily
from snakesim_hal.model.scenario import RunConfig, load_scenario, parse_set_option
from snakesim_hal.model.scene_file.scene import Cylinder
from snakesim_hal.network.client import HostClient
from snakesim_hal.wire.messages import WorldModel
from snakesim_operator.results.metrics.map_score import score_map
from snakesim_operator.run.in_process import simulate

pytestmark = pytest.mark.e2e
LIES = [
    Cylinder(position_m=(1.75 + 0.3 * k, 0.55 * (-1) ** k), radius_m=0.07, name=f"lie_{k}")
    for k in range(12)
]
HOW = (
    "robot=planar13_camera",
    "controller=path_following",
    "control.look_ahead_m=0.1",
    "duration_s=2.5",
)


class Deceived(GuidanceService):
    """Guidance whose configuration has another scene than the simulator's."""

    seen: ClassVar[list[WorldModel]] = []

    def __init__(self, client: HostClient, config: RunConfig) -> None:
        scene = msgspec.structs.replace(
            config.scene, cylinder=LIES, pegs_along_route=[], random_field=[]
        )
        super().__init__(client, msgspec.structs.replace(config, scene=scene))


def worlds(map_: str, *more: str, deceived: bool = False) -> tuple[list[WorldModel], RunConfig]:
    """What guidance told in a run on a row of pegs."""
    config = load_scenario(
        "peg_row", [parse_set_option(text) for text in (*HOW, f'mission.map="{map_}"', *more)]
    ).config
    with register_plugin_temporarily(
        SERVICES, "guidance", Deceived if deceived else GuidanceService
    ):
        result = simulate(config)
    assert result.summary.ended == "complete"
    assert (result.summary.path_distance_m or 0) > 0.3
    record, last = result.record, result.record.worlds[-1]
    nodes = record.find_body_points_w(record.find_nearest_row(last.timestamp_ns * 1e-9))
    assert nodes is not None
    truth, along = [placed.obstacle for placed in record.placed_obstacles], nodes[-1] - nodes[-2]
    found = score_map(last.obstacles, truth, nodes[-1], float(np.arctan2(along[1], along[0])))
    if map_ == "perceived":
        assert len(found.position_errors_m) >= 4
        assert not found.ghost_count
        assert not found.missed_count
        assert np.median(found.position_errors_m) < 0.02
    return record.worlds, config


def test_perceived_map_is_independent_of_scene_file():
    honest, _ = worlds("perceived")
    deceived, _ = worlds("perceived", deceived=True)
    common = min(len(honest), len(deceived))
    assert common > 20
    assert honest[1:common] == deceived[1:common]  # how often tick 0 is shown is chance


def test_dead_reckoning_localizes_without_pose_sensor() -> None:
    reported, _ = worlds("perceived", "mission.localization=dead_reckoning")
    assert all(world.pose_timestamp_ns is None for world in reported)
    sd_m = reported[-1].base_position_sd_m
    assert sd_m is not None
    assert 0.0 < sd_m < 0.05


def test_known_is_what_the_scene_file_says():
    reported, _ = worlds("known", deceived=True)
    obstacles = [o for world in reported for o in world.obstacles]
    assert obstacles
    assert all(o.name.startswith("lie_") for o in obstacles)
    assert all(o.last_seen_ns is None for o in obstacles)
    assert compute_outline_distance_m(obstacles[0], np.array(LIES[0].position_m)) < 0
