"""A trained policy as an ONNX file with the metadata that the controller `policy` asks for."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from snakesim.training.form import FELT_RAD, OBSERVE, RAMP_PER_S, Policy
from snakesim_gnc.control.policy import ACTION, FRAME_SKIP, JOINTS, OBSERVATIONS, opened
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.textfiles import exported

LEARNED = "snakesim.learned"
OPSET, IR = 17, 10  # that onnxruntime 1.20 reads
NODES = (  # as `Policy.targets`
    ("MatMul", ("seen", "time"), "time_s"),
    ("Mul", ("time_s", "omega"), "turned"),
    ("Sub", ("turned", "lag"), "phase"),
    ("Sin", ("phase",), "wave"),
    ("Mul", ("time_s", "ramp_per_s"), "ramp"),
    ("Min", ("ramp", "one"), "ramped"),
    ("MatMul", ("seen", "yielding"), "yields"),
    ("Add", ("amplitude", "yields"), "swing"),
    ("Mul", ("ramped", "swing"), "ramped_swing"),
    ("Mul", ("ramped_swing", "wave"), "waving"),
    ("MatMul", ("seen", "steering"), "steers"),
    ("Add", ("waving", "steers"), "steered"),
    ("MatMul", ("seen", "feeling"), "feels"),
    ("Tanh", ("feels",), "felt"),
    ("Mul", ("felt", "felt_rad"), "felt_by"),
    ("Add", ("steered", "felt_by"), "target_rad"),
)


def learned_by(policy: str) -> dict[str, float]:
    """The numbers of a policy that was trained here, shipped or a file. Raises ConfigError."""
    _, told = opened(policy)
    try:
        return msgspec.json.decode(told.get(LEARNED, ""), type=dict[str, float])
    except msgspec.MsgspecError:
        raise ConfigError(
            f"--from {policy}: does not tell what `snakesim train` has learned; give a policy.onnx that it has written"
        ) from None


def export(file: Path, policy: Policy, values: Mapping[str, float], frame_skip: int, again: Sequence[str]) -> None:
    """Write it. values: the learned numbers, and again: the command that finds them, are told in the metadata."""
    width, joints = policy.time.shape
    numbers = {"ramp_per_s": RAMP_PER_S, "one": 1.0, "felt_rad": FELT_RAD}
    arrays = {**vars(policy), **{name: np.array(value, np.float32) for name, value in numbers.items()}}
    graph = helper.make_graph(
        [helper.make_node(kind, list(inputs), [output]) for kind, inputs, output in NODES],
        "policy",
        [helper.make_tensor_value_info("seen", TensorProto.FLOAT, [1, width])],
        [helper.make_tensor_value_info("target_rad", TensorProto.FLOAT, [1, joints])],
        [numpy_helper.from_array(array, name) for name, array in arrays.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR)
    properties = {
        OBSERVATIONS: ",".join(OBSERVE),
        ACTION: "position",
        JOINTS: str(joints),
        FRAME_SKIP: str(frame_skip),
        "snakesim.trained_by": " ".join(again),
        LEARNED: json.dumps({name: round(value, 6) for name, value in values.items()}),
    }
    helper.set_model_props(model, properties)
    onnx.checker.check_model(model)
    with exported(file) as partial:
        onnx.save(model, partial)
