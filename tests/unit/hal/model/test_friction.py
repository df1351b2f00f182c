"""Coefficients of friction by direction depend on skins, wheels and surfaces. Impossible values are refused."""

from typing import Any

import msgspec
import pytest

from snakesim_hal.model.scene_file.friction import (
    PassiveWheels,
    Skin,
    Surface,
    compute_link_factors,
    compute_surface_friction,
)
from snakesim_testing.sim.simulator_rig import make_config

SCALES = {"forward": 0.11, "backward": 0.14, "sideways": 0.19}
WHEELS = {"radius_m": 0.03, "bearing_radius_m": 0.004, "bearing_friction": 0.03}
MILK_SNAKE = msgspec.convert(SCALES, Skin)
BALL_BEARINGS = msgspec.convert(WHEELS, PassiveWheels)


def test_friction_without_skin_is_equal_in_all_directions() -> None:
    assert compute_surface_friction(0.3, Surface(), None, None) == (0.3, 0.3, 0.3)


@pytest.mark.parametrize("friction", [0.19, 0.38])
def test_friction_of_skin_uses_only_its_ratios(friction: float) -> None:
    scale = friction / 0.19
    expected = pytest.approx((0.11 * scale, 0.14 * scale, 0.19 * scale))
    assert compute_surface_friction(friction, Surface(), MILK_SNAKE, None) == expected


def test_friction_of_surface_replaces_that_of_the_skin() -> None:
    surface = Surface(forward_friction=0.05)
    assert compute_surface_friction(0.19, surface, MILK_SNAKE, None) == pytest.approx(
        (0.05, 0.14, 0.19)
    )
    assert compute_surface_friction(0.3, surface, None, None) == (0.05, 0.3, 0.3)


def test_friction_of_wheels_is_rolling_along_and_sliding_sideways() -> None:
    wheels = msgspec.convert(
        {**WHEELS, "rolling_resistance": 0.01, "tire_friction": 0.6}, PassiveWheels
    )
    assert compute_surface_friction(
        0.2, Surface(forward_friction=0.1), None, wheels
    ) == pytest.approx((0.014, 0.014, 0.6))
    assert compute_surface_friction(0.2, None, None, BALL_BEARINGS) == pytest.approx(
        (0.004, 0.004, 0.2)
    )


def test_friction_of_wheels_on_ice_is_sliding() -> None:
    assert compute_surface_friction(0.001, None, None, BALL_BEARINGS) == (0.001, 0.001, 0.001)


def test_friction_factors_of_link_are_relative_to_the_skin() -> None:
    skin = msgspec.convert(
        {**SCALES, "links": {"link_2": {"forward": 0.22, "sideways": 0.095}}}, Skin
    )
    assert compute_link_factors(skin, 4) == [
        (1, 1, 1),
        (1, 1, 1),
        pytest.approx((2.0, 1.0, 0.5)),
        (1, 1, 1),
    ]
    assert compute_link_factors(None, 2) == [(1, 1, 1), (1, 1, 1)]


@pytest.mark.parametrize(
    ("robot", "expected_texts"),
    [
        (
            {"skin": {**SCALES, "links": {"link_14": {}}}},
            ["skin.links.link_14", "link_0", "link_13"],
        ),
        ({"skin": SCALES, "wheels": WHEELS}, ["[skin]", "[wheels]", "leave one out"]),
        ({"wheels": {**WHEELS, "bearing_radius_m": 0.03}}, ["bearing_radius_m", "0.03 m", "below"]),
        ({"skin": {**SCALES, "sideways": 0.0}}, ["> 0"]),
    ],
)
def test_impossible_skins_and_wheels_are_refused(
    robot: dict[str, Any], expected_texts: list[str]
) -> None:
    with pytest.raises(msgspec.ValidationError) as refusal:
        make_config(robot)
    for text in expected_texts:
        assert text in str(refusal.value)
