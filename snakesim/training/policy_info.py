"""What `snakesim policy info` prints: the metadata of an ONNX file."""

from snakesim.training.exported import LEARNED_PARAMETERS_KEY
from snakesim_gnc.control.policy import (
    ACTION_KEY,
    FRAME_SKIP_KEY,
    JOINTS_KEY,
    OBSERVATIONS_KEY,
    load_model,
)
from snakesim_hal.base.terminal import print_json, print_line

METADATA_PREFIX = "snakesim."
LABEL_BY_KEY = {
    JOINTS_KEY: "joints of the robot",
    OBSERVATIONS_KEY: "observations",
    ACTION_KEY: "action of each joint",
    FRAME_SKIP_KEY: "ticks of an action",
}


def show_policy(policy: str, *, as_json: bool) -> int:
    """Print the metadata of a policy.

    Args:
        policy: Path of an ONNX file, or the name of a shipped policy.
        as_json: Whether to print one JSON object instead of text.

    Returns:
        The exit code, 0.

    Raises:
        ConfigError: There is no such policy, or it cannot be read.
    """
    session, metadata = load_model(policy)
    shapes = {
        tensor.name: list(tensor.shape)
        for tensor in (*session.get_inputs(), *session.get_outputs())
    }
    if as_json:
        print_json(
            {
                "policy": policy,
                "controller": "policy",
                "metadata": dict(metadata),
                "tensors": shapes,
            }
        )
        return 0
    print_line(f"{policy}: run it with --controller policy:{policy}")
    label_width = max(len(label) for label in LABEL_BY_KEY.values())
    for key, label in LABEL_BY_KEY.items():
        print_line(f"  {label:<{label_width}}  {metadata.get(key, 'unknown')}")
    for key in sorted(metadata.keys() - LABEL_BY_KEY.keys() - {LEARNED_PARAMETERS_KEY}):
        print_line(
            f"  {key.removeprefix(METADATA_PREFIX).replace('_', ' '):<{label_width}}  {metadata[key]}"
        )
    for name, shape in shapes.items():
        print_line(f"  {'tensor ' + name:<{label_width}}  {tuple(shape)}")
    return 0
