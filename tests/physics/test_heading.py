"""Somebody steers: the direction of an intent counts instead of the mission's goal."""

import pytest

from snakesim_hal.in_process import InProcessRun
from snakesim_hal.model.scenario import load, parse_set
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Intent, World

DENSE = parse_set("scene.random_field.0.density_per_m2=12")
NINE_S = parse_set("duration_s=9")


@pytest.mark.parametrize("side", [1, pytest.param(-1, marks=pytest.mark.slow)])
def test_the_snake_goes_where_somebody_steers_it(side: int) -> None:
    with InProcessRun(load("surveyed_clutter", [DENSE, NINE_S]).config) as run:
        session = run.network.session()
        intents, worlds = session.publisher(keys.INTENT, Intent), session.reader(keys.WORLD, World)
        places: list[float] = []
        for turn, _ in enumerate(run.turns()):
            if turn % 20 == 0:
                intents.put(Intent(stamp_ns=run.host.status().stamp_ns, who="ann", heading_w_rad=side * 0.7))
            places += [world.centre_w[1] for world in worlds.drain() if world.centre_w is not None]
        session.close()
    assert side * (places[-1] - places[0]) > 0.25
