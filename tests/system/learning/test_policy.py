"""A policy from an ONNX file drives a robot as it did in its environment; another is refused before anything starts."""

import re
import runpy
import subprocess
import sys
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

import snakesim
from snakesim.environments import SnakeEnv
from snakesim_gnc.control.policy import PolicyModel
from snakesim_testing.messages import raises_error
from snakesim_testing.runs.documents import REPOSITORY, parse_sections
from snakesim_testing.runs.in_process_command import snakesim as command_line

JOINTS, FRAME_SKIP = 13, 5
# Dyadic, so that no order of sums rounds differently.
SHIFT_S = np.arange(JOINTS, dtype=np.float32) / np.float32(8)
METADATA = {
    "snakesim.observations": "angle_rad,velocity_rad_s,time_s",
    "snakesim.action": "position",
    "snakesim.joints": str(JOINTS),
    "snakesim.frame_skip": str(FRAME_SKIP),
}


def saved(
    file: Path,
    kind: int = TensorProto.FLOAT,
    rows: int | str = 1,
    width: int = 2 * JOINTS + 1,
    **changes,
) -> Path:
    """A model that bends the joints one after the other: |t - shift| / 4 + angle / 2, with other metadata if asked."""
    weights = np.zeros((2 * JOINTS + 1, JOINTS), dtype=np.float32)
    weights[-1] = 1.0
    feedback = np.zeros_like(weights)
    feedback[:JOINTS] = np.eye(JOINTS) / 2
    constants = {
        "W": weights,
        "F": feedback,
        "shift": SHIFT_S,
        "gain": np.array([0.25], np.float32),
    }
    steps = [
        ("MatMul", ["x", "W"], "t"),
        ("Sub", ["t", "shift"], "since"),
        ("Abs", ["since"], "far"),
        ("Mul", ["far", "gain"], "bend"),
        ("MatMul", ["x", "F"], "half"),
        ("Add", ["bend", "half"], "y"),
    ]
    if (kind, width) != (TensorProto.FLOAT, 2 * JOINTS + 1):  # a valid model, of another shape
        steps, constants = [("Identity", ["x"], "y")], {}
    graph = helper.make_graph(
        [helper.make_node(op, given, [gives]) for op, given, gives in steps],
        "policy",
        [helper.make_tensor_value_info("x", kind, [rows, width])],
        [helper.make_tensor_value_info("y", kind, [rows, JOINTS if constants else width])],
        [onnx.numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10)
    helper.set_model_props(
        model, {key: value for key, value in (METADATA | changes).items() if value is not None}
    )
    onnx.save(model, file)
    return file


class Same(snakesim.Controller):
    """The same in Python."""

    needs_world = False

    def __init__(self, robot, parameters):
        super().__init__(robot, parameters)
        self.ticks = 0

    def update(self, observation):
        if self.ticks % FRAME_SKIP == 0:
            bend = np.abs(np.float32(observation.time_s) - SHIFT_S) * np.float32(0.25)
            self.target = (
                bend + np.array(observation.joints.angle_rad, np.float32) * np.float32(0.5)
            ).tolist()
        self.ticks += 1
        return snakesim.ControllerCommand(snakesim.make_position_setpoints(self.robot, self.target))


def driven(model: Path, scenario: str = "triplet", duration: float = 0.1) -> snakesim.Result:
    return snakesim.run(
        scenario, controller="policy", duration=duration, set={"control.model": str(model)}
    )


@pytest.mark.parametrize("rows", [1, "batch"])
def test_a_policy_commands_what_the_same_arithmetic_in_python_does(
    tmp_path: Path, rows: int | str
) -> None:
    found = driven(saved(tmp_path / "model.onnx", rows=rows), duration=2)
    same = snakesim.run("triplet", controller=Same, duration=2)
    assert found.complete
    assert found.digest == same.digest
    assert np.ptp(found["target.joint_5"]) > 0.1


EVERYTHING = (
    "time_s,angle_rad,velocity_rad_s,torque_nm,goal_bearing,goal_m,contact_n,"
    "position_w_m,orientation_wxyz,velocity_w_m_s,angular_velocity_w_rad_s"
)
EPISODES = {
    "simulator": {},
    "emulated modules": {"backend": "can"},
    "waypoints": {
        "mission.goal": {"kind": "waypoints", "points_m": [[1.2, 0.1], [3.0, 0.0]], "within_m": 0.5}
    },
    "a slow sensor": {"robot.sensors.pose.rate_hz": 20},
}


@pytest.mark.parametrize(
    "case", ["simulator", *(pytest.param(n, marks=pytest.mark.slow) for n in list(EPISODES)[1:])]
)
def test_policy_controller_gets_observations_of_its_environment(tmp_path: Path, case: str) -> None:
    """To the bit: targets that depend on every number of the observation have one digest."""
    env: Any = SnakeEnv(
        "surveyed_clutter",
        observe=EVERYTHING.split(","),
        duration=2,
        new_field=False,
        set=EPISODES[case],
    )
    width = len(env.observation_names)
    file = linear(tmp_path / "model.onnx", width)
    model = PolicyModel(env.description, str(file))
    seen, _ = env.reset(seed=1)
    varied, over, info = [seen], False, {}
    while not over:
        seen, _, terminated, truncated, info = env.step(model(seen))
        varied.append(seen)
        over = terminated or truncated
    env.close()
    spread = zip(env.observation_names, np.ptp(varied, axis=0), strict=True)
    told = {name.partition(".")[0] for name, by in spread if by}
    given = {**EPISODES[case], "control.model": str(file)}
    run = snakesim.run("surveyed_clutter", controller="policy", duration=2, seed=1, set=given)
    assert told == set(EVERYTHING.split(","))  # nothing in it stands still
    assert run.complete
    assert info["digest"] == run.digest


def linear(file: Path, width: int) -> Path:
    """A model that moves every joint by small shares of everything that it sees."""
    weights = np.random.default_rng(1).normal(size=(width, JOINTS)).astype(np.float32) * np.float32(
        0.01
    )
    graph = helper.make_graph(
        [
            helper.make_node("MatMul", ["x", "W"], ["mixed"]),
            helper.make_node("Sin", ["mixed"], ["y"]),
        ],
        "policy",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, width])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, JOINTS])],
        [onnx.numpy_helper.from_array(weights, "W")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10)
    helper.set_model_props(model, METADATA | {"snakesim.observations": EVERYTHING})
    onnx.save(model, file)
    return file


def test_policy_with_silent_sensor_holds_robot_and_says_why(tmp_path: Path) -> None:
    width = len(SnakeEnv("surveyed_clutter", observe=EVERYTHING.split(",")).observation_names)
    slow = {"robot.sensors.pose.rate_hz": 2, "max_age.pose_s": 0.1}  # half a second between samples
    given = {"control.model": str(linear(tmp_path / "model.onnx", width)), **slow}
    run = snakesim.run("surveyed_clutter", controller="policy", duration=1, set=given)
    target, time_s = run["target.joint_5"], run.time_s - run.time_s[0]
    assert run.complete
    assert np.ptp(target[time_s < 0.1]) > 0
    assert np.ptp(target[(time_s > 0.25) & (time_s < 0.48)]) == 0
    assert np.ptp(target[time_s > 0.48]) > 0


@pytest.mark.parametrize("command", [("run", "--out", "run"), ("config",)])
def test_a_robot_without_the_sensor_is_refused_before_anything_starts(
    tmp_path: Path, command: Sequence[str]
) -> None:
    width = len(SnakeEnv("surveyed_clutter", observe=EVERYTHING.split(",")).observation_names)
    linear(tmp_path / "model.onnx", width)
    shipped = Path(str(files("snakesim_hal") / "shipped"))
    touchless = re.sub(
        r"\[sensors\.contacts\][^\[]*", "", (shipped / "robots/planar13.toml").read_text()
    )
    (tmp_path / "touchless.toml").write_text(touchless)
    scenario = (
        (shipped / "scenarios/triplet.toml").read_text().replace('"planar13"', '"./touchless.toml"')
    )
    (tmp_path / "blind.toml").write_text(scenario)
    given = ("--controller", "policy", "--set", "control.model=model.onnx")
    done = command_line(command[0], "./blind.toml", *command[1:], *given, cwd=tmp_path)
    assert done.code == 2
    assert "model.onnx: metadata `snakesim.observations`" in done.err
    assert "'contact_n' needs sensor/contacts, which robot 'planar13' has not" in done.err, done.err
    assert not (tmp_path / "run").exists()


WRONG = {
    "joints": {"snakesim.joints": "12"},
    "missing": {"snakesim.action": None},
    "action": {"snakesim.action": "angle"},
    "part": {"snakesim.observations": "angle_deg"},
    "skip": {"snakesim.frame_skip": "0"},
    "few": {"snakesim.observations": "angle_rad"},
    "double": {"width": 27, "kind": TensorProto.DOUBLE},
    "output": {"width": 14, "snakesim.observations": "angle_rad,time_s"},
}


@pytest.mark.parametrize("case", WRONG)
def test_policy_model_mismatch_names_file_field_and_expectation(tmp_path: Path, case: str) -> None:
    with raises_error(snakesim.ConfigError, code="policy/invalid", field=f"{case}.onnx"):
        driven(saved(tmp_path / f"{case}.onnx", **WRONG[case]))


def test_the_snippet_of_the_documentation_makes_a_model_that_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocks = [
        code
        for one in parse_sections(REPOSITORY / "docs" / "how-to" / "policies.md")
        for _, code in one.blocks
    ]
    (tmp_path / "named.py").write_text(next(code for code in blocks if "set_model_props" in code))
    monkeypatch.chdir(tmp_path)
    linear(Path("trained.onnx"), 3 * JOINTS)
    runpy.run_path("named.py")
    assert snakesim.run("peg_row", controller="policy:./model.onnx", duration=0.3).complete


def test_what_is_no_model_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.onnx").write_text("weights")
    with raises_error(snakesim.ConfigError, code="policy/invalid", field="text.onnx"):
        driven(tmp_path / "text.onnx")
    with raises_error(snakesim.ConfigError, code="file/not-found", field="none.onnx"):
        driven(tmp_path / "none.onnx")
    with raises_error(
        snakesim.ConfigError, code="config/missing-key", field="controllers.policy.model"
    ):
        snakesim.run("triplet", controller="policy")


def test_without_its_extra_it_says_what_to_install(tmp_path: Path) -> None:
    lacking = "import sys; sys.modules['onnxruntime'] = None; from snakesim_operator.cli import main; sys.exit(main())"
    words = ("run", "triplet", "--in-process", "--controller", "policy", "--duration", "0.1")
    given = (
        "--set",
        f"control.model={saved(tmp_path / 'model.onnx')}",
        "--out",
        str(tmp_path / "run"),
    )
    done = subprocess.run(
        [sys.executable, "-c", lacking, *words, *given], capture_output=True, text=True, check=False
    )
    assert (
        "policy needs onnxruntime: " in done.stderr
        and "pip install 'snakesim[policy]'" in done.stderr
    ), done
