"""The operator steers: the snake follows the heading of an intent instead of the mission's goal."""

import pytest

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_hal.programs.single_process import InProcessRun
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import LocomotionIntent, WorldModel

DENSE = parse_set_option("scene.random_field.0.density_per_m2=12")


TICKS_PER_INTENT = 20


def measure_movement_to_left_m(heading_w_rad: float, seconds: int, seed: int) -> float:
    """Run through dense clutter with an operator who requests this heading."""
    config = load_scenario(
        "surveyed_clutter",
        [DENSE, parse_set_option(f"duration_s={seconds}"), parse_set_option(f"seed={seed}")],
    ).config
    with InProcessRun(config) as run:
        session = run.network.create_session()
        intents = session.declare_publisher(keys.INTENT, LocomotionIntent)
        world_models = session.declare_reader(keys.WORLD, WorldModel)
        positions_y_m: list[float] = []
        for tick, _ in enumerate(run.iterate_ticks()):
            if tick % TICKS_PER_INTENT == 0:
                intents.put(
                    LocomotionIntent(
                        timestamp_ns=run.host.build_status().timestamp_ns,
                        requester="ann",
                        heading_w_rad=heading_w_rad,
                    )
                )
            positions_y_m += [
                world_model.center_w[1]
                for world_model in world_models.drain()
                if world_model.center_w is not None
            ]
        session.close()
    return positions_y_m[-1] - positions_y_m[0]


@pytest.mark.slow  # the planner's heading: tests/unit/gnc/navigation/test_clutter_planner.py
def test_snake_with_heading_intent_moves_to_that_side() -> None:
    assert measure_movement_to_left_m(0.7, seconds=9, seed=1) > 0.25


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_snake_with_opposite_heading_intents_moves_to_opposite_sides(seed: int) -> None:
    """The distances may differ, because obstacles on one side may force the snake to search for contacts."""
    movement_m = measure_movement_to_left_m(0.7, 15, seed)
    opposite_movement_m = measure_movement_to_left_m(-0.7, 15, seed)
    assert movement_m > opposite_movement_m + 0.5
