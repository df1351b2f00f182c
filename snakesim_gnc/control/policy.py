"""A learned policy as a controller: an ONNX model that maps an observation to one target for each joint.

The metadata of the model name its observation, its action, its number of joints and its frame skip. All of them are
checked against the robot when the model is loaded.
"""

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from snakesim_gnc.control.observations import (
    ObservationBuilder,
    ObservationPart,
    make_observation_parts,
    select_observation_parts,
)
from snakesim_hal.base.errors import ConfigError, shorten, suggest_word
from snakesim_hal.controller import (
    Controller,
    ControllerCommand,
    Observation,
    Telemetry,
    make_position_setpoints,
)
from snakesim_hal.model.files import SHIPPED_FILES_DIR, FileStruct, expand_home
from snakesim_hal.model.plugins import make_pip_install_command
from snakesim_hal.model.textfiles import read_bytes
from snakesim_hal.wire.messages import JointMode, RobotDescription
from snakesim_hal.wire.setpoints import RequestedSetpoints

ONNX_RUNTIME: Any = None
with contextlib.suppress(ModuleNotFoundError):
    # Imported when this file is loaded: the policy is constructed while the robot arms, and that must not wait.
    import onnxruntime

    ONNX_RUNTIME = onnxruntime

# Names of the metadata properties.
OBSERVATIONS_KEY = "snakesim.observations"
ACTION_KEY = "snakesim.action"
JOINTS_KEY = "snakesim.joints"
FRAME_SKIP_KEY = "snakesim.frame_skip"

MODE_BY_ACTION = {
    "position": JointMode.POSITION,
    "velocity": JointMode.VELOCITY,
    "torque": JointMode.TORQUE,
}
MAX_FRAME_SKIP = 1000  # ticks; a longer pause between two targets is a mistake
MAX_INTEGER_DIGITS = 9  # of a number in the metadata; more digits are a mistake

# Shipped policies.
POLICY_FOLDER = SHIPPED_FILES_DIR / "policies"
MODEL_SUFFIX = ".onnx"


class PolicyModel:
    """A model from a file, with its metadata. Calling it computes targets from an observation."""

    def __init__(self, robot: RobotDescription, file: str) -> None:
        """Load the model and check that it fits the robot.

        Args:
            robot: The robot that the model is going to move.
            file: Path of an ONNX file, or the name of a shipped policy.

        Raises:
            ConfigError: The model does not fit; the error names the file, the field, its value and what is expected.
        """
        self._session, properties = load_model(file)
        metadata = _ModelMetadata(file, properties)

        # What the model observes and returns.
        self.parts = metadata.read_parts(robot)
        self.action = metadata.read_choice(ACTION_KEY, MODE_BY_ACTION)
        # Ticks per inference.
        self.frame_skip = metadata.read_integer(FRAME_SKIP_KEY, MAX_FRAME_SKIP, "ticks")
        _check_joints_of_model(metadata, robot, self.action, self.parts)

        # Names of the model's tensors.
        width = sum(len(part.names) for part in self.parts.values())
        joint_count = len(robot.joints)
        self._input_name = _find_only_tensor_name(
            "input", self._session.get_inputs(), width, ", ".join(self.parts), file
        )
        self._output_name = _find_only_tensor_name(
            "output", self._session.get_outputs(), joint_count, "a target for each joint", file
        )

    def __call__(self, observation: NDArray[np.float32]) -> list[float]:
        """Return the targets of all joints, tail to head, for an observation of shape (width,)."""
        batch = observation[None]
        (targets,) = self._session.run([self._output_name], {self._input_name: batch})
        return targets[0].tolist()


def _check_joints_of_model(
    metadata: "_ModelMetadata",
    robot: RobotDescription,
    action: str,
    observation_parts: Mapping[str, ObservationPart],
) -> None:
    """Check that the robot has the joints that the model commands and observes.

    Args:
        metadata: Metadata of the model, with its number of joints.
        robot: The robot that the model is going to move.
        action: What the model commands, a key of MODE_BY_ACTION.
        observation_parts: What the model observes, by name.

    Raises:
        ConfigError: The number of joints differs, or a joint does not have the mode or the measurement that the model
            needs.
    """
    joint_count = len(robot.joints)
    model_joint_count = metadata.read_integer(JOINTS_KEY)
    if model_joint_count != joint_count:
        requirement = f"{joint_count}, the number of joints of robot {robot.robot!r}"
        raise metadata.make_error(JOINTS_KEY, model_joint_count, requirement)
    for joint in robot.joints:
        if not joint.supports_mode(MODE_BY_ACTION[action]):
            supported_actions = [
                name for name, mode in MODE_BY_ACTION.items() if joint.supports_mode(mode)
            ]
            requirement = f"what {joint.name} can do: {', '.join(supported_actions)}"
            raise metadata.make_error(ACTION_KEY, action, requirement)
        if "torque_nm" in observation_parts and "torque" not in joint.measures:
            requirement = f"without torque_nm: {joint.name} measures none"
            raise metadata.make_error(OBSERVATIONS_KEY, ",".join(observation_parts), requirement)


class PolicyParameters(FileStruct, frozen=True, kw_only=True):
    """The model."""

    model: Annotated[str, Meta(min_length=1, max_length=1024)]
    """Name of a shipped model, or path of an ONNX file."""


class PolicyController(Controller[PolicyParameters]):
    """Runs the model every `snakesim.frame_skip` ticks, and repeats its targets in between."""

    Parameters = PolicyParameters
    needs_world = False
    uses_sensors = True

    def __init__(self, robot: RobotDescription, parameters: PolicyParameters) -> None:
        """Load the model. Raises ConfigError if it does not fit the robot."""
        super().__init__(robot, parameters)
        self._torque_limits_nm = [joint.torque_limit_nm for joint in robot.joints]

        # The model.
        self._model = PolicyModel(robot, parameters.model)
        self._observation_builder = ObservationBuilder(robot, self._model.parts)
        self._mode = MODE_BY_ACTION[self._model.action]

        # Its last targets.
        self._last_targets: list[float] | None = None  # None if the next tick runs the model
        self._last_inference_tick = 0  # tick at which the model ran last

        # Setpoints that hold the pose while a sensor is late; None while all sensors are fresh.
        self._hold_setpoints: RequestedSetpoints | None = None

    @classmethod
    def check(cls, robot: RobotDescription, parameters: PolicyParameters) -> None:
        """Check before a run that the model fits the robot. Raises ConfigError."""
        PolicyModel(robot, parameters.model)

    def update(self, observation: Observation) -> ControllerCommand:
        """Return the model's targets, or setpoints that hold the pose while a sensor that the model needs is late.

        The model runs every `frame_skip` ticks; between two inferences its last targets are repeated. The command
        limiter limits the targets.

        Args:
            observation: The inputs of this tick.

        Returns:
            Setpoints of all joints in the mode of the model.
        """
        late_reason = self._describe_late_sensors(observation)
        if late_reason:
            return self._hold_pose(observation, late_reason)
        self._hold_setpoints = None
        if (
            self._last_targets is None
            or observation.tick - self._last_inference_tick >= self._model.frame_skip
        ):
            self._last_targets = self._model(
                self._observation_builder.build_observation(observation)
            )
            self._last_inference_tick = observation.tick
        modes = [self._mode] * len(self._last_targets)
        setpoints = RequestedSetpoints(
            modes, list(self._last_targets), list(self._torque_limits_nm)
        )
        reference: Sequence[float] = ()
        if self._mode is JointMode.POSITION:
            reference = self._last_targets
        return ControllerCommand(
            setpoints, Telemetry(reason="a policy moves the joints", reference_rad=reference)
        )

    def _describe_late_sensors(self, observation: Observation) -> str:
        """Return why samples that the model needs are too old; an empty text if all are fresh."""
        if observation.sensor_samples is None:
            return ""
        late_reasons_by_key = observation.sensor_samples.late
        return "; ".join(
            late_reasons_by_key[key]
            for key in sorted(self._observation_builder.sensors & late_reasons_by_key.keys())
        )

    def _hold_pose(self, observation: Observation, reason: str) -> ControllerCommand:
        """Return setpoints that hold the pose which the robot had when the sensor became late.

        The next update without a late sensor runs the model at once.
        """
        if self._hold_setpoints is None:
            self._hold_setpoints = make_position_setpoints(self.robot, observation.joints.angle_rad)
        self._last_targets = None
        return ControllerCommand(self._hold_setpoints, Telemetry(reason=reason))


class _ModelMetadata:
    """Reads and checks the metadata properties of a model, which are texts. Its methods raise ConfigError."""

    def __init__(self, file: str, properties: Mapping[str, str]) -> None:
        self._file = shorten(file)
        self._properties = properties

    def read_parts(self, robot: RobotDescription) -> dict[str, ObservationPart]:
        """Return the parts of the observation, in the order in which the model expects them. Raises ConfigError."""
        available = make_observation_parts(robot)
        requirement = f"names out of {', '.join(available)}, each once, with commas between"
        text = self._read_text(OBSERVATIONS_KEY, requirement)
        names = [name.strip() for name in text.split(",")]
        has_unknown_names = not set(names) <= set(available)
        has_repeated_names = len(set(names)) < len(names)
        if has_unknown_names or has_repeated_names:
            raise self.make_error(OBSERVATIONS_KEY, text, requirement)
        try:
            return select_observation_parts(robot, names)
        except ConfigError as error:
            raise ConfigError(
                f"{self._file}: metadata `{OBSERVATIONS_KEY}` is {shorten(text)!r}: {error}",
                code="policy/invalid",
            ) from None

    def read_choice(self, property_name: str, choices: Mapping[str, Any]) -> str:
        """Return a metadata property that must be one of the choices. Raises ConfigError."""
        requirement = f"one of {', '.join(choices)}"
        text = self._read_text(property_name, requirement).strip()
        if text not in choices:
            raise self.make_error(property_name, text, requirement)
        return text

    def read_integer(self, property_name: str, maximum: int | None = None, unit: str = "") -> int:
        """Return a metadata property as an integer from 1 to `maximum`.

        Args:
            property_name: Name of the metadata property.
            maximum: Upper bound; None for no upper bound.
            unit: Unit of the number, for the error message; empty for a count.

        Raises:
            ConfigError: The property is missing, is not an integer, or is out of range.
        """
        requirement = "a whole number"
        if unit:
            requirement += f" of {unit}"
        requirement += " from 1"
        if maximum is not None:
            requirement += f" to {maximum}"
        text = self._read_text(property_name, requirement).strip()
        is_number = text.isascii() and text.isdigit() and len(text) <= MAX_INTEGER_DIGITS
        if not is_number:
            raise self.make_error(property_name, text, requirement)
        value = int(text)
        if value < 1 or (maximum is not None and value > maximum):
            raise self.make_error(property_name, text, requirement)
        return value

    def make_error(self, property_name: str, value: object, requirement: str) -> ConfigError:
        """Return an error that names the file, a metadata property, its value and what is allowed.

        Args:
            property_name: Name of the metadata property.
            value: Its value.
            requirement: What it must be; the error continues with this text after "must be".
        """
        return ConfigError(
            f"{self._file}: metadata `{property_name}` is {shorten(str(value))!r}, must be {requirement}",
            code="policy/invalid",
        )

    def _read_text(self, property_name: str, requirement: str) -> str:
        """Return a metadata property as it is written in the file.

        Args:
            property_name: Name of the metadata property.
            requirement: What it must be; the error continues with this text after "must be".

        Raises:
            ConfigError: There is no such property.
        """
        if property_name not in self._properties:
            available = ", ".join(sorted(self._properties)) or "no metadata"
            raise ConfigError(
                f"{self._file}: has no metadata `{property_name}`, which must be {requirement}; there is "
                f"{shorten(available, 200)}",
                code="policy/invalid",
            )
        return self._properties[property_name]


def _find_model_file(name: str) -> Path:
    """Return the path of a model from its path as written, or from the name of a shipped policy.

    Raises:
        ConfigError: No shipped policy has this name.
    """
    if "/" in name or name.endswith(MODEL_SUFFIX):
        return expand_home(name)
    shipped = sorted(path.stem for path in POLICY_FOLDER.glob(f"*{MODEL_SUFFIX}"))
    if name not in shipped:
        raise ConfigError(
            f"no policy called {shorten(name)!r}; {suggest_word(name, shipped)}shipped are {', '.join(shipped)}. For a "
            f"file of your own give its path, such as ./{shorten(name)}{MODEL_SUFFIX}",
            code="config/unknown-name",
        )
    return POLICY_FOLDER / f"{name}{MODEL_SUFFIX}"


def load_model(file: str) -> tuple[Any, Mapping[str, str]]:
    """Load a policy's ONNX model into an inference session that gives the same results on every computer.

    Args:
        file: Path of an ONNX file, or the name of a shipped policy.

    Returns:
        An inference session of onnxruntime, and the metadata properties of the model.

    Raises:
        ConfigError: The file cannot be read or is no model, or onnxruntime is not installed.
    """
    data = read_bytes(_find_model_file(file))
    if ONNX_RUNTIME is None:
        raise ConfigError(
            f"controller policy needs onnxruntime: {make_pip_install_command('policy')}",
            code="extra/not-installed",
        )
    options = ONNX_RUNTIME.SessionOptions()
    # One thread adds in the same order on every computer, so that results are equal to the bit.
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    # Errors only: they are raised as well, and would be printed twice below.
    options.log_severity_level = 3
    try:
        session = ONNX_RUNTIME.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises many classes that share no base class
        raise ConfigError(
            f"{shorten(file)}: cannot be loaded as an ONNX model: {shorten(str(error), 300)}",
            code="policy/invalid",
        ) from error
    return session, session.get_modelmeta().custom_metadata_map


def _find_only_tensor_name(
    kind: str, tensors: Sequence[Any], width: int, content: str, file: str
) -> str:
    """Return the name of a model's only input or output tensor, after a check of its type and shape.

    Args:
        kind: "input" or "output", for the error message.
        tensors: All inputs or all outputs of the model.
        width: The tensor must be float32 of shape (1, width); its first dimension may be dynamic.
        content: What the values of the tensor are, for the error message.
        file: Path of the model's file, for the error message.

    Raises:
        ConfigError: There is not exactly one tensor, or it has another type or shape.
    """
    if len(tensors) == 1 and _has_shape(tensors[0], width):
        return tensors[0].name
    descriptions = [f"{tensor.name} {tensor.type} {tuple(tensor.shape)}" for tensor in tensors]
    available = shorten("; ".join(descriptions) or "none", 200)
    raise ConfigError(
        f"{shorten(file)}: {kind} is {available}, must be one tensor(float), that is float32, of shape (1, {width}): "
        f"{content}",
        code="policy/invalid",
    )


def _has_shape(tensor: Any, width: int) -> bool:
    """Return whether a tensor is float32 of shape (1, width), where the first dimension may also be dynamic."""
    if tensor.type != "tensor(float)" or len(tensor.shape) != 2:
        return False
    batch_size, tensor_width = tensor.shape
    batch_is_open = not isinstance(batch_size, int)  # a symbolic dimension is a text
    return tensor_width == width and (batch_is_open or batch_size == 1)
