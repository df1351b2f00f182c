"""A policy from an ONNX file drives a robot as in its environment; an unsuitable file is refused before the start."""

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

JOINTS = 13
FRAME_SKIP = 5
SIMPLE_INPUTS = 2 * JOINTS + 1  # angle and velocity of each joint, and the time
# Delay of each joint. Multiples of 1/8 s are exact, so that sums in any order have the same bits.
SHIFT_S = np.arange(JOINTS, dtype=np.float32) / np.float32(8)
METADATA = {
    "snakesim.observations": "angle_rad,velocity_rad_s,time_s",
    "snakesim.action": "position",
    "snakesim.joints": str(JOINTS),
    "snakesim.frame_skip": str(FRAME_SKIP),
}


def save_simple_model(
    file: Path,
    kind: int = TensorProto.FLOAT,
    rows: int | str = 1,
    width: int = SIMPLE_INPUTS,
    **changes,
) -> Path:
    """Save a model that bends the joints one after the other: |t - shift| / 4 + angle / 2.

    Args:
        file: Path of the model.
        kind: Element type of its input and output.
        rows: Number of rows of its input, or the name of a variable number.
        width: Number of inputs. With another type or width the model returns its input.
        changes: Metadata that differ from METADATA; None removes a key.

    Returns:
        The path.
    """
    weights = np.zeros((SIMPLE_INPUTS, JOINTS), dtype=np.float32)
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
    if (kind, width) != (TensorProto.FLOAT, SIMPLE_INPUTS):
        steps = [("Identity", ["x"], "y")]
        constants = {}
    graph = helper.make_graph(
        [helper.make_node(operator, inputs, [output]) for operator, inputs, output in steps],
        "policy",
        [helper.make_tensor_value_info("x", kind, [rows, width])],
        [helper.make_tensor_value_info("y", kind, [rows, JOINTS if constants else width])],
        [onnx.numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=10)
    metadata = METADATA | changes
    helper.set_model_props(
        model, {key: value for key, value in metadata.items() if value is not None}
    )
    onnx.save(model, file)
    return file


class SimpleModelInPython(snakesim.Controller):
    """A controller that computes the same targets as the simple model."""

    needs_world = False

    def __init__(self, robot, parameters):
        super().__init__(robot, parameters)
        self.ticks = 0

    def update(self, observation):
        if self.ticks % FRAME_SKIP == 0:
            bend_rad = np.abs(np.float32(observation.time_s) - SHIFT_S) * np.float32(0.25)
            angle_rad = np.array(observation.joints.angle_rad, np.float32)
            self.targets_rad = (bend_rad + angle_rad * np.float32(0.5)).tolist()
        self.ticks += 1
        setpoints = snakesim.make_position_setpoints(self.robot, self.targets_rad)
        return snakesim.ControllerCommand(setpoints)


def run_policy(model: Path, scenario: str = "triplet", duration: float = 0.1) -> snakesim.Result:
    """Run a scenario whose controller is the policy of a file."""
    return snakesim.run(
        scenario, controller="policy", duration=duration, set={"control.model": str(model)}
    )


@pytest.mark.heavy
@pytest.mark.parametrize("rows", [1, "batch"])
def test_policy_run_has_digest_of_same_arithmetic_in_python(
    tmp_path: Path, rows: int | str
) -> None:
    policy_run = run_policy(save_simple_model(tmp_path / "model.onnx", rows=rows), duration=2)
    python_run = snakesim.run("triplet", controller=SimpleModelInPython, duration=2)
    assert policy_run.complete
    assert policy_run.digest == python_run.digest
    assert np.ptp(policy_run["target.joint_5"]) > 0.1


ALL_OBSERVATIONS = (
    "time_s,angle_rad,velocity_rad_s,torque_nm,goal_bearing,goal_m,contact_n,"
    "position_w_m,orientation_wxyz,velocity_w_m_s,angular_velocity_w_rad_s"
)
SETTINGS = {
    "simulator": {},
    "emulated modules": {"backend": "can"},
    "waypoints": {
        "mission.goal": {"kind": "waypoints", "points_m": [[1.2, 0.1], [3.0, 0.0]], "within_m": 0.5}
    },
    "a slow sensor": {"robot.sensors.pose.rate_hz": 20},
}


@pytest.mark.heavy
@pytest.mark.parametrize(
    "case",
    ["simulator", *(pytest.param(name, marks=pytest.mark.slow) for name in list(SETTINGS)[1:])],
)
def test_policy_controller_gets_observations_of_its_environment(tmp_path: Path, case: str) -> None:
    """The run and the episode have one digest, although the targets depend on every observed number."""
    env: Any = SnakeEnv(
        "surveyed_clutter",
        observe=ALL_OBSERVATIONS.split(","),
        duration=2,
        new_field=False,
        set=SETTINGS[case],
    )
    width = len(env.observation_names)
    file = save_mixing_model(tmp_path / "model.onnx", width)
    model = PolicyModel(env.description, str(file))
    observation, info = env.reset(seed=1)
    observations = [observation]
    is_over = False
    while not is_over:
        observation, _, terminated, truncated, info = env.step(model(observation))
        observations.append(observation)
        is_over = terminated or truncated
    env.close()
    ranges = zip(env.observation_names, np.ptp(observations, axis=0), strict=True)
    varying_parts = {name.partition(".")[0] for name, value_range in ranges if value_range}
    settings = {**SETTINGS[case], "control.model": str(file)}
    run = snakesim.run("surveyed_clutter", controller="policy", duration=2, seed=1, set=settings)
    assert varying_parts == set(ALL_OBSERVATIONS.split(","))
    assert run.complete
    assert info["digest"] == run.digest


def save_mixing_model(file: Path, width: int) -> Path:
    """Save a model whose every target depends a little on each of its `width` inputs."""
    random = np.random.default_rng(1)
    weights = random.normal(size=(width, JOINTS)).astype(np.float32) * np.float32(0.01)
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
    helper.set_model_props(model, METADATA | {"snakesim.observations": ALL_OBSERVATIONS})
    onnx.save(model, file)
    return file


def test_policy_with_too_old_pose_holds_the_robot(tmp_path: Path) -> None:
    width = len(SnakeEnv("surveyed_clutter", observe=ALL_OBSERVATIONS.split(",")).observation_names)
    # The pose arrives every 0.5 s and is too old after 0.1 s.
    slow_pose = {"robot.sensors.pose.rate_hz": 2, "max_age.pose_s": 0.1}
    settings = {
        "control.model": str(save_mixing_model(tmp_path / "model.onnx", width)),
        **slow_pose,
    }
    run = snakesim.run("surveyed_clutter", controller="policy", duration=1, set=settings)
    target_rad = run["target.joint_5"]
    time_s = run.time_s - run.time_s[0]
    assert run.complete
    assert np.ptp(target_rad[time_s < 0.1]) > 0
    assert np.ptp(target_rad[(time_s > 0.25) & (time_s < 0.48)]) == 0
    assert np.ptp(target_rad[time_s > 0.48]) > 0


@pytest.mark.parametrize("command", [("run", "--out", "run"), ("config",)])
def test_policy_on_robot_without_its_sensor_is_refused_before_start(
    tmp_path: Path, command: Sequence[str]
) -> None:
    width = len(SnakeEnv("surveyed_clutter", observe=ALL_OBSERVATIONS.split(",")).observation_names)
    save_mixing_model(tmp_path / "model.onnx", width)
    shipped = Path(str(files("snakesim_hal") / "shipped"))
    robot = (shipped / "robots/planar13.toml").read_text()
    robot_without_contacts = re.sub(r"\[sensors\.contacts\][^\[]*", "", robot)
    (tmp_path / "without_contacts.toml").write_text(robot_without_contacts)
    scenario = (shipped / "scenarios/triplet.toml").read_text()
    scenario = scenario.replace('"planar13"', '"./without_contacts.toml"')
    (tmp_path / "scenario.toml").write_text(scenario)
    options = ("--controller", "policy", "--set", "control.model=model.onnx")
    completed = command_line(command[0], "./scenario.toml", *command[1:], *options, cwd=tmp_path)
    assert completed.code == 2
    assert "model.onnx: metadata `snakesim.observations`" in completed.err
    assert "'contact_n' needs sensor/contacts, which robot 'planar13' has not" in completed.err, (
        completed.err
    )
    assert not (tmp_path / "run").exists()


METADATA_ERRORS = {  # arguments of save_simple_model, by the name of the case
    "joints": {"snakesim.joints": "12"},
    "missing": {"snakesim.action": None},
    "action": {"snakesim.action": "angle"},
    "part": {"snakesim.observations": "angle_deg"},
    "skip": {"snakesim.frame_skip": "0"},
    "few": {"snakesim.observations": "angle_rad"},
    "double": {"width": 27, "kind": TensorProto.DOUBLE},
    "output": {"width": 14, "snakesim.observations": "angle_rad,time_s"},
}


@pytest.mark.parametrize("case", METADATA_ERRORS)
def test_policy_with_wrong_metadata_or_shape_is_refused(tmp_path: Path, case: str) -> None:
    with raises_error(snakesim.ConfigError, code="policy/invalid", field=f"{case}.onnx"):
        run_policy(save_simple_model(tmp_path / f"{case}.onnx", **METADATA_ERRORS[case]))


def test_policies_page_example_makes_a_model_that_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocks = [
        code
        for section in parse_sections(REPOSITORY / "docs" / "how-to" / "policies.md")
        for _, code in section.blocks
    ]
    (tmp_path / "named.py").write_text(next(code for code in blocks if "set_model_props" in code))
    monkeypatch.chdir(tmp_path)
    save_mixing_model(Path("trained.onnx"), 3 * JOINTS)
    runpy.run_path("named.py")
    assert snakesim.run("peg_row", controller="policy:./model.onnx", duration=0.3).complete


def test_policy_with_missing_or_invalid_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.onnx").write_text("weights")
    with raises_error(snakesim.ConfigError, code="policy/invalid", field="text.onnx"):
        run_policy(tmp_path / "text.onnx")
    with raises_error(snakesim.ConfigError, code="file/not-found", field="none.onnx"):
        run_policy(tmp_path / "none.onnx")
    with raises_error(
        snakesim.ConfigError, code="config/missing-key", field="controllers.policy.model"
    ):
        snakesim.run("triplet", controller="policy")


def test_policy_without_onnxruntime_names_the_extra(tmp_path: Path) -> None:
    program = "import sys; sys.modules['onnxruntime'] = None; from snakesim_operator.cli import main; sys.exit(main())"
    command = ("run", "triplet", "--in-process", "--controller", "policy", "--duration", "0.1")
    options = (
        "--set",
        f"control.model={save_simple_model(tmp_path / 'model.onnx')}",
        "--out",
        str(tmp_path / "run"),
    )
    completed = subprocess.run(
        [sys.executable, "-c", program, *command, *options],
        capture_output=True,
        text=True,
        check=False,
    )
    assert "policy needs onnxruntime: " in completed.stderr, completed
    assert "pip install 'snakesim[policy]'" in completed.stderr, completed
