"""Emulated drives are mounted reversed, with an offset, or behind a gear, with and without a matching robot file."""

from functools import partial

import pytest

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.run.in_process import simulate

EVERY_SECOND_JOINT = [f"joint_{i}" for i in range(2, 14, 2)]
MIXED_MOUNTING = [
    "joint_3.zero_rad=0.5",
    "joint_4.sign=-1",
    "joint_5.gear=1.5",
    "joint_5.zero_rad=-0.2",
]


def simulate_peg_row(*options: str, backend: str = "can", duration_s: float = 1.2) -> RunSummary:
    """Run a row of pegs with emulated drives."""
    texts = (f"backend={backend}", f"duration_s={duration_s}", *options)
    config = load_scenario("peg_row", [parse_set_option(text) for text in texts]).config
    return simulate(config).summary


@pytest.fixture(scope="module")
def nominal() -> RunSummary:
    """Provide the run of a robot without unusual mounting."""
    return simulate_peg_row()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("backend", "other_keys"),
    [
        ("odrive", ["joint_7.gear=2"]),
        pytest.param("moteus", ["joint_7.gear=2"], marks=pytest.mark.slow),
        # A servo does not store its revolutions, so that a gear would leave too little range.
        ("dynamixel", []),
    ],
)
def test_drives_mounted_reversed_move_the_robot_equally(
    backend: str, other_keys: list[str]
) -> None:
    run = partial(simulate_peg_row, backend=backend, duration_s=1.0)
    nominal = run()
    reversed_keys = [f"{joint}.sign=-1" for joint in EVERY_SECOND_JOINT]
    joint_keys = [*reversed_keys, "joint_5.zero_rad=0.4", *other_keys]
    mounting = [f"backend.mounted.{key}" for key in joint_keys]
    declaration = [f"robot.joints.{key}" for key in joint_keys]
    declared = run(*mounting, *declaration)
    undeclared = run(*mounting)
    assert nominal.path_distance_m
    assert nominal.peak_joint_torque_nm
    assert undeclared.peak_joint_torque_nm
    assert declared.path_distance_m == pytest.approx(nominal.path_distance_m, rel=0.05)
    assert undeclared.peak_joint_torque_nm > 1.5 * nominal.peak_joint_torque_nm, (
        "a wrong robot file has no visible effect"
    )


@pytest.mark.heavy
def test_modules_mounted_reversed_and_declared_give_the_same_run(nominal: RunSummary) -> None:
    declaration = [f"robot.joints.{joint}.sign=-1" for joint in EVERY_SECOND_JOINT]
    declared = simulate_peg_row(*declaration)
    assert declared.command_digest == nominal.command_digest
    assert declared.path_distance_m == nominal.path_distance_m

    undeclared = simulate_peg_row(
        *(f"backend.mounted.{joint}.sign=-1" for joint in EVERY_SECOND_JOINT)
    )
    assert nominal.path_distance_m
    assert undeclared.path_distance_m
    assert undeclared.path_distance_m < 0.6 * nominal.path_distance_m, (
        "a wrong robot file has no visible effect"
    )

    wrongly_declared = simulate_peg_row(
        *declaration, *(f"backend.mounted.{joint}.sign=1" for joint in EVERY_SECOND_JOINT)
    )
    assert wrongly_declared.command_digest == undeclared.command_digest, (
        "a wrong declaration differs from a missing one"
    )


@pytest.mark.heavy
def test_drives_with_zero_and_gear_change_only_quantization(nominal: RunSummary) -> None:
    mixed = simulate_peg_row(*(f"robot.joints.{key}" for key in MIXED_MOUNTING))
    assert mixed.path_distance_m == pytest.approx(nominal.path_distance_m, rel=0.05)
    # Angles behind a gear are rounded differently.
    assert mixed.command_digest != nominal.command_digest
