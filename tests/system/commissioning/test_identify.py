"""`snakesim robot identify` on emulated modules whose parameters are hidden from it, by processes of their own."""

import random
import tomllib
from pathlib import Path

import pytest

from snakesim_testing.runs.in_process_command import run_to_summary, snakesim

FIELDS = {
    "friction_nm": 0.15,
    "viscous_nm_s_per_rad": 0.1,
    "armature_kg_m2": 0.005,
    "response_time_s": 0.01,
}
PERIOD_S = 0.005  # of the shipped scenario
WITHIN = {"viscous_nm_s_per_rad": 0.2}  # of the truth; the others 0.1
ROBOT = """extends = "planar13"
name = "suspended"
[chain]
modules = 3
[motor]
friction_nm = 0.15
viscous_nm_s_per_rad = 0.1 # a guess
"""


@pytest.mark.slow  # python -m verification commissioning
def test_hidden_parameters_are_found_and_written_down(tmp_path: Path) -> None:
    pick = random.Random(7)
    truth = {
        f"joint_{i}": {field: value * pick.uniform(0.7, 1.3) for field, value in FIELDS.items()}
        for i in (1, 2, 3)
    }
    (tmp_path / "snake.toml").write_text(ROBOT)
    hidden = [
        f"backends.can.mounted.{name}.{field}={value}"
        for name, of in truth.items()
        for field, value in of.items()
    ]
    sets = [
        word for text in (f"robot={tmp_path / 'snake.toml'}", *hidden) for word in ("--set", text)
    ]
    ended, _ = run_to_summary(tmp_path / "run", "identify", "--backend", "can", *sets)
    assert ended.code == 0, ended.out + ended.err
    ended = snakesim("robot", "identify", "run", "--write", "snake.toml", cwd=tmp_path)
    assert ended.code == 0, ended.out + ended.err
    assert ended.out.count("unknown: torque constant: the file has none") == 3
    text = (tmp_path / "snake.toml").read_text()
    assert "# a guess" in text
    assert "# identified from run, " in text
    found = tomllib.loads(text)["joints"]
    for name, of in truth.items():
        for field, value in of.items():
            assert abs(found[name][field] / value - 1) < WITHIN.get(field, 0.1), (
                f"{name} {field}: {found[name]}, {of}"
            )
        # Modules follow a target at the next Sync.
        assert abs(found[name]["latency_s"] - PERIOD_S) < 0.2 * PERIOD_S
    assert "Torque of joint_3, measured" in (tmp_path / "run" / "identified.html").read_text()


@pytest.mark.slow
def test_a_robot_that_does_not_hang_is_not_identified(tmp_path: Path) -> None:
    given = ("backends.sim.suspended=false", "robot.chain.modules=3", "robot.motor.friction_nm=0.1")
    sets = [word for text in given for word in ("--set", text)]
    run_to_summary(tmp_path / "run", "identify", "--duration", "12", *sets)
    (tmp_path / "snake.toml").write_text(ROBOT)
    ended = snakesim("robot", "identify", "run", "--write", "snake.toml", cwd=tmp_path)
    assert ended.code == 1 and "does not move as a robot that hangs by its tail" in ended.out, (
        ended.out + ended.err
    )
    ended = snakesim("robot", "identify", "run", "--write", "planar13", cwd=tmp_path)
    assert ended.code == 2
    assert "give the path of your own robot file" in ended.err
