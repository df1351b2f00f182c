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

from snakesim_gnc.control.observations import ObservationPart, Observer, make_parts, select_parts
from snakesim_hal.base.errors import ConfigError, shorten, suggest_word
from snakesim_hal.controller import Controller, ControllerCommand, Observation, Telemetry, positions
from snakesim_hal.model.files import SHIPPED, FileStruct, expand_home
from snakesim_hal.model.plugins import pip_install
from snakesim_hal.model.textfiles import read_bytes
from snakesim_hal.wire.messages import Description, Mode
from snakesim_hal.wire.setpoints import RequestedSetpoints

RUNTIME: Any = None
with contextlib.suppress(ModuleNotFoundError):
    # Imported when this file is loaded: the policy is constructed while the robot arms, and that must not wait.
    import onnxruntime

    RUNTIME = onnxruntime

# Names of the metadata properties.
OBSERVATIONS = "snakesim.observations"
ACTION = "snakesim.action"
JOINTS = "snakesim.joints"
FRAME_SKIP = "snakesim.frame_skip"

MODES = {"position": Mode.POSITION, "velocity": Mode.VELOCITY, "torque": Mode.TORQUE}
MAX_FRAME_SKIP = 1000  # ticks; a longer pause between two targets is a mistake
MAX_DIGITS = 9  # of a number in the metadata; more digits are a mistake

# Shipped policies.
POLICIES = SHIPPED / "policies"
SUFFIX = ".onnx"


class Model:
    """A model from a file, with its metadata. Calling it computes targets from an observation."""

    def __init__(self, robot: Description, file: str) -> None:
        """Load the model and check that it fits the robot.

        Args:
            robot: the robot that the model is going to move.
            file: path of an ONNX file, or the name of a shipped policy.

        Raises:
            ConfigError: the model does not fit; the error names the file, the field, its value and what is expected.
        """
        self._session, properties = load_model(file)
        metadata = _Metadata(file, properties)

        # What the model observes and returns.
        self.parts = metadata.read_parts(robot)
        self.action = metadata.read_choice(ACTION, MODES)
        self.frame_skip = metadata.read_integer(FRAME_SKIP, MAX_FRAME_SKIP, "ticks")  # ticks per inference
        _check_joints(metadata, robot, self.action, self.parts)

        # Names of the model's tensors.
        width = sum(len(part.names) for part in self.parts.values())
        joint_count = len(robot.joints)
        self._input = _check_tensor("input", self._session.get_inputs(), width, ", ".join(self.parts), file)
        self._output = _check_tensor(
            "output", self._session.get_outputs(), joint_count, "a target for each joint", file
        )

    def __call__(self, observation: NDArray[np.float32]) -> list[float]:
        """Return the targets of all joints, tail to head, for an observation of shape (width,)."""
        batch = observation[None]
        (targets,) = self._session.run([self._output], {self._input: batch})
        return targets[0].tolist()


def _check_joints(metadata: "_Metadata", robot: Description, action: str, parts: Mapping[str, ObservationPart]) -> None:
    """Check that the robot has the joints that the model commands and observes. Raises ConfigError."""
    joint_count = len(robot.joints)
    expected_count = metadata.read_integer(JOINTS)
    if expected_count != joint_count:
        allowed = f"{joint_count}, the number of joints of robot {robot.robot!r}"
        raise metadata.make_error(JOINTS, expected_count, allowed)
    for joint in robot.joints:
        if not joint.supports_mode(MODES[action]):
            available = [name for name, mode in MODES.items() if joint.supports_mode(mode)]
            raise metadata.make_error(ACTION, action, f"what {joint.name} can do: {', '.join(available)}")
        if "torque_nm" in parts and "torque" not in joint.measures:
            allowed = f"without torque_nm: {joint.name} measures none"
            raise metadata.make_error(OBSERVATIONS, ",".join(parts), allowed)


class PolicyParameters(FileStruct, frozen=True, kw_only=True):
    """The model."""

    model: Annotated[str, Meta(min_length=1, max_length=1024)]
    """Name of a shipped model, or path of an ONNX file."""


class Policy(Controller[PolicyParameters]):
    """Runs the model every `snakesim.frame_skip` ticks, and repeats its targets in between."""

    Parameters = PolicyParameters
    needs_world = False
    uses_sensors = True

    def __init__(self, robot: Description, parameters: PolicyParameters) -> None:
        """Load the model. Raises ConfigError if it does not fit the robot."""
        super().__init__(robot, parameters)
        self._torque_limit_nm = [joint.torque_limit_nm for joint in robot.joints]

        # The model.
        self._model = Model(robot, parameters.model)
        self._observer = Observer(robot, self._model.parts)
        self._mode = MODES[self._model.action]

        # Its last targets.
        self._target: list[float] | None = None  # None: the next tick runs the model
        self._target_tick = 0  # tick at which the model ran last

        # Setpoints that hold the pose while a sensor is late; None while all sensors are fresh.
        self._hold_setpoints: RequestedSetpoints | None = None

    @classmethod
    def check(cls, robot: Description, parameters: PolicyParameters) -> None:
        """Check before a run that the model fits the robot. Raises ConfigError."""
        Model(robot, parameters.model)

    def update(self, observation: Observation) -> ControllerCommand:
        """Return the model's targets, or setpoints that hold the pose while a sensor that the model needs is late.

        The model runs every `frame_skip` ticks; between two inferences its last targets are repeated. The command
        limiter limits the targets.

        Args:
            observation: the inputs of this tick.

        Returns:
            Setpoints of all joints in the mode of the model.
        """
        why_late = self._describe_late_sensors(observation)
        if why_late:
            return self._hold_pose(observation, why_late)
        self._hold_setpoints = None
        if self._target is None or observation.tick - self._target_tick >= self._model.frame_skip:
            self._target = self._model(self._observer.update(observation))
            self._target_tick = observation.tick
        modes = [self._mode] * len(self._target)
        setpoints = RequestedSetpoints(modes, list(self._target), list(self._torque_limit_nm))
        reference: Sequence[float] = ()
        if self._mode is Mode.POSITION:
            reference = self._target
        return ControllerCommand(setpoints, Telemetry(reason="a policy moves the joints", reference_rad=reference))

    def _describe_late_sensors(self, observation: Observation) -> str:
        """Return why samples that the model needs must not be used; empty when all are fresh."""
        if observation.sensor_samples is None:
            return ""
        late = observation.sensor_samples.late
        return "; ".join(late[key] for key in sorted(self._observer.sensors & late.keys()))

    def _hold_pose(self, observation: Observation, why: str) -> ControllerCommand:
        """Hold the pose that the robot had when the sensor became late."""
        if self._hold_setpoints is None:
            self._hold_setpoints = positions(self.robot, observation.joints.angle_rad)
        self._target = None
        return ControllerCommand(self._hold_setpoints, Telemetry(reason=why))


class _Metadata:
    """Reads and checks the metadata properties of a model, which are texts. Its methods raise ConfigError."""

    def __init__(self, file: str, properties: Mapping[str, str]) -> None:
        self._file = shorten(file)
        self._properties = properties

    def read_parts(self, robot: Description) -> dict[str, ObservationPart]:
        """Return the parts of the observation, in the order in which the model expects them."""
        available = make_parts(robot)
        allowed = f"names out of {', '.join(available)}, each once, with commas between"
        text = self._read_text(OBSERVATIONS, allowed)
        names = [name.strip() for name in text.split(",")]
        has_unknown_names = not set(names) <= set(available)
        has_repeated_names = len(set(names)) < len(names)
        if has_unknown_names or has_repeated_names:
            raise self.make_error(OBSERVATIONS, text, allowed)
        try:
            return select_parts(robot, names)
        except ConfigError as error:
            raise ConfigError(
                f"{self._file}: metadata `{OBSERVATIONS}` is {shorten(text)!r}: {error}", code="policy/invalid"
            ) from None

    def read_choice(self, field: str, choices: Mapping[str, Any]) -> str:
        """Return a text that is one of the choices."""
        allowed = f"one of {', '.join(choices)}"
        text = self._read_text(field, allowed).strip()
        if text not in choices:
            raise self.make_error(field, text, allowed)
        return text

    def read_integer(self, field: str, maximum: int | None = None, unit: str = "") -> int:
        """Return an integer from 1 to `maximum`; None: without an upper bound."""
        allowed = "a whole number"
        if unit:
            allowed += f" of {unit}"
        allowed += " from 1"
        if maximum is not None:
            allowed += f" to {maximum}"
        text = self._read_text(field, allowed).strip()
        is_number = text.isascii() and text.isdigit() and len(text) <= MAX_DIGITS
        if not is_number:
            raise self.make_error(field, text, allowed)
        value = int(text)
        if value < 1 or (maximum is not None and value > maximum):
            raise self.make_error(field, text, allowed)
        return value

    def make_error(self, field: str, value: object, allowed: str) -> ConfigError:
        """Return an error that names the file, the field, its value and what is allowed."""
        return ConfigError(
            f"{self._file}: metadata `{field}` is {shorten(str(value))!r}, must be {allowed}", code="policy/invalid"
        )

    def _read_text(self, field: str, allowed: str) -> str:
        if field not in self._properties:
            available = ", ".join(sorted(self._properties)) or "no metadata"
            raise ConfigError(
                f"{self._file}: has no metadata `{field}`, which must be {allowed}; there is {shorten(available, 200)}",
                code="policy/invalid",
            )
        return self._properties[field]


def _find_model_file(name: str) -> Path:
    """Return the path of a model from its path as written, or from the name of a shipped policy.

    Raises:
        ConfigError: no shipped policy has this name.
    """
    if "/" in name or name.endswith(SUFFIX):
        return expand_home(name)
    shipped = sorted(path.stem for path in POLICIES.glob(f"*{SUFFIX}"))
    if name not in shipped:
        raise ConfigError(
            f"no policy called {shorten(name)!r}; {suggest_word(name, shipped)}shipped are {', '.join(shipped)}. For a "
            f"file of your own give its path, such as ./{shorten(name)}{SUFFIX}",
            code="config/unknown-name",
        )
    return POLICIES / f"{name}{SUFFIX}"


def load_model(file: str) -> tuple[Any, Mapping[str, str]]:
    """Load a policy's ONNX model into an inference session that gives the same results on every computer.

    Args:
        file: path of an ONNX file, or the name of a shipped policy.

    Returns:
        An inference session of onnxruntime, and the metadata properties of the model.

    Raises:
        ConfigError: the file cannot be read or is no model, or onnxruntime is not installed.
    """
    data = read_bytes(_find_model_file(file))
    if RUNTIME is None:
        raise ConfigError(f"controller policy needs onnxruntime: {pip_install('policy')}", code="extra/not-installed")
    options = RUNTIME.SessionOptions()
    # One thread adds in the same order on every computer, so that results are equal to the bit.
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.log_severity_level = 3  # errors only: they are raised as well, and would be printed twice below
    try:
        session = RUNTIME.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises many classes that share no base class
        raise ConfigError(
            f"{shorten(file)}: cannot be loaded as an ONNX model: {shorten(str(error), 300)}", code="policy/invalid"
        ) from error
    return session, session.get_modelmeta().custom_metadata_map


def _check_tensor(kind: str, tensors: Sequence[Any], width: int, meaning: str, file: str) -> str:
    """Return the name of a model's only input or output after a check of its type and shape.

    Args:
        kind: "input" or "output", for the error.
        tensors: all inputs or all outputs of the model.
        width: the tensor must be float32 of shape (1, width); its first dimension may be dynamic.
        meaning: what the numbers of the tensor mean, for the error.
        file: the model's file, for the error.

    Raises:
        ConfigError: there is not exactly one tensor, or it has another type or shape.
    """
    if len(tensors) == 1 and _has_width(tensors[0], width):
        return tensors[0].name
    descriptions = [f"{tensor.name} {tensor.type} {tuple(tensor.shape)}" for tensor in tensors]
    available = shorten("; ".join(descriptions) or "none", 200)
    raise ConfigError(
        f"{shorten(file)}: {kind} is {available}, must be one tensor(float), that is float32, of shape (1, {width}): "
        f"{meaning}",
        code="policy/invalid",
    )


def _has_width(tensor: Any, width: int) -> bool:
    """Return whether a tensor is float32 of shape (1, width), where the 1 may be left open."""
    if tensor.type != "tensor(float)" or len(tensor.shape) != 2:
        return False
    batch_size, tensor_width = tensor.shape
    batch_is_open = not isinstance(batch_size, int)  # a symbolic dimension is a text
    return tensor_width == width and (batch_is_open or batch_size == 1)
