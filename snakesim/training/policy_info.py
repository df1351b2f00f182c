"""What `snakesim policy info` prints: the metadata of an ONNX file."""

from snakesim.training.exported import LEARNED
from snakesim_gnc.control.policy import ACTION, FRAME_SKIP, JOINTS, OBSERVATIONS, load_model
from snakesim_hal.base.terminal import print_json, print_line

PREFIX = "snakesim."
LABELS = {
    JOINTS: "joints of the robot",
    OBSERVATIONS: "observations",
    ACTION: "action of each joint",
    FRAME_SKIP: "ticks of an action",
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
    shapes = {tensor.name: list(tensor.shape) for tensor in (*session.get_inputs(), *session.get_outputs())}
    if as_json:
        print_json({"policy": policy, "controller": "policy", "metadata": dict(metadata), "tensors": shapes})
        return 0
    print_line(f"{policy}: run it with --controller policy:{policy}")
    width = max(len(label) for label in LABELS.values())
    for key, label in LABELS.items():
        print_line(f"  {label:<{width}}  {metadata.get(key, 'unknown')}")
    for key in sorted(metadata.keys() - LABELS.keys() - {LEARNED}):
        print_line(f"  {key.removeprefix(PREFIX).replace('_', ' '):<{width}}  {metadata[key]}")
    for name, shape in shapes.items():
        print_line(f"  {'tensor ' + name:<{width}}  {tuple(shape)}")
    return 0
