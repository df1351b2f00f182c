"""Writes a trained policy as an ONNX file, with the metadata that the controller `policy` needs."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from snakesim.training.form import MAX_REACTION_RAD, OBSERVE, RAMP_PER_S, PolicyArrays
from snakesim_gnc.control.policy import (
    ACTION_KEY,
    FRAME_SKIP_KEY,
    JOINTS_KEY,
    OBSERVATIONS_KEY,
    load_model,
)
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.textfiles import export_atomically

LEARNED_PARAMETERS_KEY = "snakesim.learned"
OPSET_VERSION = 17  # the newest ones that onnxruntime 1.20 reads
IR_VERSION = 10
GRAPH_NODES = (  # operator, inputs, output; together they compute `PolicyArrays.compute_targets`
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


def read_learned_parameters(policy: str) -> dict[str, float]:
    """Return the parameters of a policy that `snakesim policy train` has written.

    Args:
        policy: Name of a shipped policy, or path of an ONNX file.

    Raises:
        ConfigError: There is no such policy, or another program has written it.
    """
    _, metadata = load_model(policy)
    try:
        return msgspec.json.decode(metadata.get(LEARNED_PARAMETERS_KEY, ""), type=dict[str, float])
    except msgspec.MsgspecError:
        raise ConfigError(
            f"--init {policy}: holds no numbers of `snakesim policy train`; give a policy.onnx that it has written",
            code="command/invalid-option",
        ) from None


def write_onnx_file(
    path: Path,
    policy: PolicyArrays,
    values: Mapping[str, float],
    frame_skip: int,
    again: Sequence[str],
) -> None:
    """Write a policy into an ONNX file.

    Args:
        path: Path of the file to write. An existing file is replaced.
        policy: Arrays of the policy, which become constants of the graph.
        values: Parameters of the policy. They are stored in the metadata, to continue the search from them.
        frame_skip: Number of ticks of the robot for each action.
        again: Command line that finds the same policy. It is stored in the metadata.
    """
    observation_size, joint_count = policy.time.shape
    constants = {"ramp_per_s": RAMP_PER_S, "one": 1.0, "felt_rad": MAX_REACTION_RAD}
    arrays = dict(vars(policy))
    for name, value in constants.items():
        arrays[name] = np.array(value, np.float32)
    graph = helper.make_graph(
        [helper.make_node(kind, list(inputs), [output]) for kind, inputs, output in GRAPH_NODES],
        "policy",
        [helper.make_tensor_value_info("seen", TensorProto.FLOAT, [1, observation_size])],
        [helper.make_tensor_value_info("target_rad", TensorProto.FLOAT, [1, joint_count])],
        [numpy_helper.from_array(array, name) for name, array in arrays.items()],
    )
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", OPSET_VERSION)], ir_version=IR_VERSION
    )
    metadata = {
        OBSERVATIONS_KEY: ",".join(OBSERVE),
        ACTION_KEY: "position",
        JOINTS_KEY: str(joint_count),
        FRAME_SKIP_KEY: str(frame_skip),
        "snakesim.trained_by": " ".join(again),
        LEARNED_PARAMETERS_KEY: json.dumps(
            {name: round(value, 6) for name, value in values.items()}
        ),
    }
    helper.set_model_props(model, metadata)
    onnx.checker.check_model(model)
    with export_atomically(path) as partial:
        onnx.save(model, partial)
