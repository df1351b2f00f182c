"""Modules that are mounted the other way round, off zero, or behind a gear: declared, and not. On emulated modules."""

from functools import partial

import pytest

from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.run.in_process import simulate

EVERY_SECOND = [f"joint_{i}" for i in range(2, 14, 2)]
MIXED = ["joint_3.zero_rad=0.5", "joint_4.sign=-1", "joint_5.gear=1.5", "joint_5.zero_rad=-0.2"]


def simulate_peg_row(*sets: str, backend: str = "can", duration_s: float = 1.2) -> RunSummary:
    fixed = (f"backend={backend}", f"duration_s={duration_s}")
    return simulate(
        load_scenario("peg_row", [parse_set_option(text) for text in (*fixed, *sets)]).config
    ).summary


@pytest.fixture(scope="module")
def plain() -> RunSummary:
    return simulate_peg_row()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("backend", "others"),
    [
        ("odrive", ["joint_7.gear=2"]),
        pytest.param("moteus", ["joint_7.gear=2"], marks=pytest.mark.slow),
        ("dynamixel", []),
    ],  # a servo that forgets its turns has no room for the gear
)
def test_drives_mounted_reversed_move_the_robot_equally(backend: str, others: list[str]) -> None:
    run = partial(simulate_peg_row, backend=backend, duration_s=1.0)
    nominal = run()
    built = (*(f"{joint}.sign=-1" for joint in EVERY_SECOND), "joint_5.zero_rad=0.4", *others)
    in_truth = [f"backend.mounted.{text}" for text in built]
    declared = run(*in_truth, *(f"robot.joints.{text}" for text in built))
    undeclared = run(*in_truth)
    assert nominal.path_distance_m
    assert nominal.peak_joint_torque_nm
    assert undeclared.peak_joint_torque_nm
    assert declared.path_distance_m == pytest.approx(nominal.path_distance_m, rel=0.05)
    assert undeclared.peak_joint_torque_nm > 1.5 * nominal.peak_joint_torque_nm, "it shows at once"


def test_every_second_module_reversed_and_declared_is_the_same_run(plain: RunSummary) -> None:
    declared = simulate_peg_row(*(f"robot.joints.{joint}.sign=-1" for joint in EVERY_SECOND))
    assert declared.command_digest == plain.command_digest
    assert declared.path_distance_m == plain.path_distance_m
    in_truth = [f"backend.mounted.{joint}.sign=-1" for joint in EVERY_SECOND]
    undeclared = simulate_peg_row(*in_truth)
    assert plain.path_distance_m
    assert undeclared.path_distance_m
    assert undeclared.path_distance_m < 0.6 * plain.path_distance_m, "it shows at once"
    believed = simulate_peg_row(
        *(f"robot.joints.{joint}.sign=-1" for joint in EVERY_SECOND),
        *(f"backend.mounted.{joint}.sign=1" for joint in EVERY_SECOND),
    )
    assert believed.command_digest == undeclared.command_digest, "the wrong word is as bad as none"


def test_drives_with_zero_and_gear_change_only_quantization(plain: RunSummary) -> None:
    mixed = simulate_peg_row(*(f"robot.joints.{text}" for text in MIXED))
    assert mixed.path_distance_m == pytest.approx(plain.path_distance_m, rel=0.05)
    assert mixed.command_digest != plain.command_digest, (
        "angles behind a gear are rounded otherwise"
    )
