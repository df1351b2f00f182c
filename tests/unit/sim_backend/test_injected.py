"""Faults on request that the simulator knows by itself."""

import numpy as np
import pytest

from snakesim_hal.backend import Injectable
from snakesim_hal.errors import BackendError, ConfigError
from snakesim_hal.faults.faulty_backend import FaultyBackend
from snakesim_hal.injection import parse
from snakesim_hal.model.scenario import Override, load
from snakesim_hal.wire.messages import Pace
from snakesim_sim_backend.backend import SimBackend
from snakesim_sim_backend.settings import SimSettings

PACES: tuple[Pace, ...] = ("lockstep", "realtime", "free")


def test_a_simulation_that_is_made_to_diverge_stops_and_keeps_the_last_good_state() -> None:
    backend = SimBackend(load("triplet").config, SimSettings())
    assert isinstance(backend, Injectable)
    for _ in range(3):
        backend.advance()
    before = backend.true_state()
    FaultyBackend(backend).inject(parse("diverge:simulator@1"), True)
    with pytest.raises(BackendError, match="diverged at tick 4"):
        backend.advance()
    after = backend.true_state()
    assert np.array_equal(before.angles_rad, after.angles_rad) and np.all(np.isfinite(after.velocities_rad_s))
    assert np.array_equal(before.base_position_w, after.base_position_w)
    assert np.array_equal(before.base_velocity_w, after.base_velocity_w)
    assert backend.sample(4, 40_000_000).joints.angle_rad


@pytest.mark.parametrize(
    ("text", "words"), [("leak:joint_1@1", "neither modules nor buses"), ("cut:bus_1@1", "this run has no bus")]
)
def test_what_a_simulator_has_not_is_refused_before_it_is_opened(text: str, words: str) -> None:
    config = load("triplet", [Override("faults", [text], f"--fault {text}")]).config
    with pytest.raises(ConfigError, match=words):
        SimBackend.check(config, SimSettings())
    good = ["mute:joint_1@1", "slow:simulator@1", "diverge:simulator@2", "drop:actuator/joints@1"]
    config = load("triplet", [Override("faults", good, "--fault ...")]).config
    assert SimBackend.check(config, SimSettings()) == PACES
