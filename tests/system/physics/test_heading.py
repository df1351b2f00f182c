"""Somebody steers: the direction of an intent counts instead of the mission's goal."""

import pytest

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_hal.programs.single_process import InProcessRun
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import LocomotionIntent, WorldModel

DENSE = parse_set_option("scene.random_field.0.density_per_m2=12")


def _moved_to_the_left_m(heading_w_rad: float, seconds: int, seed: int) -> float:
    config = load_scenario(
        "surveyed_clutter",
        [DENSE, parse_set_option(f"duration_s={seconds}"), parse_set_option(f"seed={seed}")],
    ).config
    with InProcessRun(config) as run:
        session = run.network.create_session()
        intents, worlds = (
            session.declare_publisher(keys.INTENT, LocomotionIntent),
            session.declare_reader(keys.WORLD, WorldModel),
        )
        places: list[float] = []
        for turn, _ in enumerate(run.iterate_ticks()):
            if turn % 20 == 0:
                intents.put(
                    LocomotionIntent(
                        timestamp_ns=run.host.build_status().timestamp_ns,
                        requester="ann",
                        heading_w_rad=heading_w_rad,
                    )
                )
            places += [world.center_w[1] for world in worlds.drain() if world.center_w is not None]
        session.close()
    return places[-1] - places[0]


@pytest.mark.slow  # the planner's heading: tests/unit/gnc/navigation/test_clutter_planner.py
def test_the_snake_goes_where_somebody_steers_it() -> None:
    assert _moved_to_the_left_m(0.7, seconds=9, seed=1) > 0.25


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_it_matters_to_which_side(seed: int) -> None:
    """Not how far: on one of two sides obstacles may stand so that it has to search."""
    assert _moved_to_the_left_m(0.7, 15, seed) > _moved_to_the_left_m(-0.7, 15, seed) + 0.5
