"""`snakesim robot identify` finds the hidden parameters of emulated modules from a run."""

import random
import tomllib
from collections.abc import Iterable
from pathlib import Path

import pytest

from snakesim_testing.runs.in_process_command import run_to_summary, snakesim

NOMINAL_VALUES = {
    "friction_nm": 0.15,
    "viscous_nm_s_per_rad": 0.1,
    "armature_kg_m2": 0.005,
    "response_time_s": 0.01,
}
PERIOD_S = 0.005  # control period of the shipped scenario
MAX_RELATIVE_ERROR = 0.1
MAX_RELATIVE_ERRORS = {"viscous_nm_s_per_rad": 0.2}  # of parameters with another limit
ROBOT_FILE = """extends = "planar13"
name = "suspended"
[chain]
modules = 3
[motor]
friction_nm = 0.15
viscous_nm_s_per_rad = 0.1 # a guess
"""
MIXED_ROBOT_FILE = """extends = "planar13"
name = "suspended"
[chain]
modules = 2
[motor]
torque_constant_nm_per_a = 0.5
[joints.joint_1]
driver = "odrive"
[joints.joint_2]
driver = "moteus"
"""


def make_set_options(settings: Iterable[str]) -> list[str]:
    """Return `--set` options for settings of the form key=value."""
    return [argument for setting in settings for argument in ("--set", setting)]


@pytest.mark.slow  # `python -m verification commissioning` repeats it for many robots
def test_identify_finds_hidden_parameters_and_writes_them_to_robot_file(tmp_path: Path) -> None:
    generator = random.Random(7)
    true_values = {
        f"joint_{number}": {
            field: value * generator.uniform(0.7, 1.3) for field, value in NOMINAL_VALUES.items()
        }
        for number in (1, 2, 3)
    }
    (tmp_path / "snake.toml").write_text(ROBOT_FILE)
    settings = [f"robot={tmp_path / 'snake.toml'}"]
    for name, values in true_values.items():
        settings += [
            f"backends.can.mounted.{name}.{field}={value}" for field, value in values.items()
        ]
    options = make_set_options(settings)
    completed, _ = run_to_summary(tmp_path / "run", "identify", "--backend", "can", *options)
    assert completed.code == 0, completed.out + completed.err
    completed = snakesim("robot", "identify", "run", "--write", "snake.toml", cwd=tmp_path)
    assert completed.code == 0, completed.out + completed.err
    assert completed.out.count("unknown: torque constant: the file has none") == 3
    text = (tmp_path / "snake.toml").read_text()
    assert "# a guess" in text
    assert "# identified from run, " in text
    identified = tomllib.loads(text)["joints"]
    for name, values in true_values.items():
        for field, value in values.items():
            error = abs(identified[name][field] / value - 1)
            limit = MAX_RELATIVE_ERRORS.get(field, MAX_RELATIVE_ERROR)
            assert error < limit, f"{name} {field}: {identified[name]}, {values}"
        # Modules apply a target at the next Sync message.
        assert abs(identified[name]["latency_s"] - PERIOD_S) < 0.2 * PERIOD_S
    assert "Torque of joint_3, measured" in (tmp_path / "run" / "identified.html").read_text()


@pytest.mark.slow
def test_identify_writes_torque_constant_only_if_driver_uses_it(tmp_path: Path) -> None:
    true_nm_per_a = 0.65  # of both drives; the file has 0.5
    robot_path = tmp_path / "snake.toml"
    robot_path.write_text(MIXED_ROBOT_FILE)
    mounted = "backends.mixed.mounted"
    options = make_set_options(
        [
            f"robot={robot_path}",
            f"{mounted}.joint_1.torque_constant_nm_per_a={true_nm_per_a}",
            f"{mounted}.joint_2.torque_constant_nm_per_a={true_nm_per_a}",
        ]
    )
    run_to_summary(tmp_path / "run", "identify", "--backend", "mixed", *options)
    completed = snakesim("robot", "identify", "run", "--write", "snake.toml", cwd=tmp_path)
    assert completed.out.count("wrong: torque constant") == 2
    assert "`torque_constant_nm_per_a` of joint_2 was left as it was" in completed.out
    written = tomllib.loads(robot_path.read_text())
    assert written["joints"]["joint_1"]["torque_constant_nm_per_a"] == pytest.approx(
        true_nm_per_a, rel=0.02
    )
    assert "torque_constant_nm_per_a" not in written["joints"]["joint_2"]
    assert "stiffness_nm_per_rad" in written["joints"]["joint_2"]


@pytest.mark.slow
def test_identify_of_robot_that_is_not_suspended_is_refused(tmp_path: Path) -> None:
    settings = (
        "backends.sim.suspended=false",
        "robot.chain.modules=3",
        "robot.motor.friction_nm=0.1",
    )
    options = make_set_options(settings)
    run_to_summary(tmp_path / "run", "identify", "--duration", "12", *options)
    (tmp_path / "snake.toml").write_text(ROBOT_FILE)
    completed = snakesim("robot", "identify", "run", "--write", "snake.toml", cwd=tmp_path)
    assert completed.code == 1, completed.out + completed.err
    assert "does not move as a robot that hangs by its tail" in completed.out, (
        completed.out + completed.err
    )
    completed = snakesim("robot", "identify", "run", "--write", "planar13", cwd=tmp_path)
    assert completed.code == 2
    assert "give the path of your own robot file" in completed.err
