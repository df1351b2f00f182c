"""A policy from an ONNX file drives a robot as the same arithmetic in Python does; another is refused."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

import snakesim

JOINTS, FRAME_SKIP = 13, 5
SHIFT_S = np.arange(JOINTS, dtype=np.float32) / np.float32(8)  # dyadic, so that no order of sums rounds differently
METADATA = {
    "snakesim.observations": "angle_rad,velocity_rad_s,time_s",
    "snakesim.action": "position",
    "snakesim.joints": str(JOINTS),
    "snakesim.frame_skip": str(FRAME_SKIP),
}


def saved(
    file: Path, kind: int = TensorProto.FLOAT, rows: int | str = 1, width: int = 2 * JOINTS + 1, **changes
) -> Path:
    """A model that bends the joints one after the other: |t - shift| / 4 + angle / 2, with other metadata if asked."""
    weights = np.zeros((2 * JOINTS + 1, JOINTS), dtype=np.float32)
    weights[-1] = 1.0
    feedback = np.zeros_like(weights)
    feedback[:JOINTS] = np.eye(JOINTS) / 2
    constants = {"W": weights, "F": feedback, "shift": SHIFT_S, "gain": np.array([0.25], np.float32)}
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
    helper.set_model_props(model, {key: value for key, value in (METADATA | changes).items() if value is not None})
    onnx.save(model, file)
    return file


class Same:
    """The same in Python."""

    NEEDS = "joints"

    class Settings(snakesim.Settings, frozen=True):
        pass

    def __init__(self, robot, settings):
        self.robot, self.ticks = robot, 0

    def update(self, view):
        if self.ticks % FRAME_SKIP == 0:
            bend = np.abs(np.float32(view.time_s) - SHIFT_S) * np.float32(0.25)
            self.target = (bend + np.float32(view.joints.angle_rad) * np.float32(0.5)).tolist()
        self.ticks += 1
        return snakesim.Action(snakesim.positions(self.robot, self.target))


def driven(model: Path, scenario: str = "triplet", duration: float = 0.1) -> snakesim.Result:
    return snakesim.run(scenario, controller="policy", duration=duration, set={"control.model": str(model)})


@pytest.mark.parametrize("rows", [1, "batch"])
def test_a_policy_commands_what_the_same_arithmetic_in_python_does(tmp_path: Path, rows: int | str) -> None:
    found = driven(saved(tmp_path / "model.onnx", rows=rows), duration=2)
    same = snakesim.run("triplet", controller=Same, duration=2)
    assert found.complete and found.digest == same.digest
    assert np.ptp(found["target.joint_5"]) > 0.1


WRONG = {
    "joints": (
        {"snakesim.joints": "12"},
        "metadata `snakesim.joints` is '12', must be 13, the number of joints of robot",
    ),
    "missing": (
        {"snakesim.action": None},
        "no metadata `snakesim.action`, which must be one of position, velocity, tor",
    ),
    "action": ({"snakesim.action": "angle"}, "`snakesim.action` is 'angle', must be one of position, velocity, torque"),
    "part": ({"snakesim.observations": "angle_deg"}, "is 'angle_deg', must be names out of angle_rad, velocity_rad_s"),
    "skip": ({"snakesim.frame_skip": "0"}, "`snakesim.frame_skip` is '0', must be a whole number of ticks from 1 to"),
    "few": (
        {"snakesim.observations": "angle_rad"},
        r"input is x tensor\(float\) \(1, 27\), must be .* \(1, 13\): angle_rad",
    ),
    "double": (
        {"width": 27, "kind": TensorProto.DOUBLE},
        r"input is x tensor\(double\) \(1, 27\), must be one tensor\(float\)",
    ),
    "output": (
        {"width": 14, "snakesim.observations": "angle_rad,time_s"},
        r"output is y tensor\(float\) \(1, 14\), must be .* of shape \(1, 13\): a target for each joint",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_a_model_that_does_not_fit_is_refused_with_file_field_and_what_is_expected(tmp_path: Path, case: str) -> None:
    changes, said = WRONG[case]
    with pytest.raises(snakesim.ControllerError, match=rf"{case}\.onnx: .*{said}"):
        driven(saved(tmp_path / f"{case}.onnx", **changes))


def test_what_is_no_model_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.onnx").write_text("weights")
    with pytest.raises(snakesim.ControllerError, match=r"text\.onnx: cannot be loaded as an ONNX model"):
        driven(tmp_path / "text.onnx")
    with pytest.raises(snakesim.ControllerError, match=r"none\.onnx: no such file"):
        driven(tmp_path / "none.onnx")
    with pytest.raises(snakesim.ConfigError, match=r"`controllers\.policy\.model` is missing"):
        snakesim.run("triplet", controller="policy")


def test_without_its_extra_it_says_what_to_install(tmp_path: Path) -> None:
    lacking = "import sys; sys.modules['onnxruntime'] = None; from snakesim_operator.cli import main; sys.exit(main())"
    words = ("run", "triplet", "--in-process", "--controller", "policy", "--duration", "0.1")
    given = ("--set", f"control.model={saved(tmp_path / 'model.onnx')}", "--out", str(tmp_path / "run"))
    done = subprocess.run([sys.executable, "-c", lacking, *words, *given], capture_output=True, text=True, check=False)
    assert "policy needs onnxruntime: " in done.stdout and "pip install 'snakesim[policy]'" in done.stdout, done
