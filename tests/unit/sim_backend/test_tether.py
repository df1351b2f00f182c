"""Tests the simulated tether, which holds the body against one direction, and hardly in any other."""

import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.messages import raises_error
from snakesim_testing.sim.simulator_rig import SimulatorRig, make_config, open_sim

ICE = {"ground": {"friction": 0.0}}
BACKWARD_TETHER = {"link": 0, "point_m": 0.0, "direction_w": [-1.0, 0.0]}


def pull_snake(force_w, tether=BACKWARD_TETHER):
    """Return the rig of a stiff snake on ice, with or without a tether, that a force pulls at link 2."""
    run = SimulatorRig(make_config({"chain": {"modules": 4}}, ICE), tether=tether)
    run.command(JointMode.POSITION)
    run.sim.data.xfrc_applied[run.sim.sim.model.body("link_2").id, :3] = force_w
    return run


def test_tether_tension_equals_the_pull():
    run = pull_snake([12.0, 0.0, 0.0])
    run.advance(1.0)
    assert run.sim.tether_tension_n == pytest.approx(12.0, rel=0.01)
    assert abs(run.sim.true_state().base_position_w[0]) < 1e-3


def test_tether_does_not_hold_along_its_pull():
    run = pull_snake([-1.0, 0.0, 0.0])
    run.advance(1.0)
    assert run.sim.tether_tension_n == pytest.approx(0.0, abs=1e-9)
    assert run.sim.true_state().base_position_w[0] == pytest.approx(-0.5 * 1.0 / 1.2, rel=0.05)


def test_tether_hardly_holds_sideways_and_has_tension_only_if_present():
    with_tether = pull_snake([0.0, 0.5, 0.0])
    without_tether = pull_snake([0.0, 0.5, 0.0], tether=None)
    with_tether.advance(0.5)
    without_tether.advance(0.5)
    assert with_tether.sim.tether_tension_n == pytest.approx(0.0, abs=0.1)
    assert without_tether.sim.tether_tension_n is None
    moved_m = with_tether.sim.true_state().base_position_w[1]
    expected_m = without_tether.sim.true_state().base_position_w[1]
    assert moved_m == pytest.approx(expected_m, rel=0.02)
    assert moved_m > 0.04


def test_tether_pulls_in_its_direction_from_any_point():
    run = pull_snake([0.0, -9.0, 0.0], {"link": 2, "point_m": 0.055, "direction_w": [0.0, 3.0]})
    run.advance(1.0)
    assert run.sim.tether_tension_n == pytest.approx(9.0, rel=0.01)


@pytest.mark.parametrize("change", [{"link": 14}, {"direction_w": [0.0, 0.0]}])
def test_tether_impossible_is_refused(change):
    with raises_error(ConfigError, code=("config/invalid-value", "config/out-of-range")):
        open_sim(make_config(), tether={**BACKWARD_TETHER, **change})
