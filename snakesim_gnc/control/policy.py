"""A learned policy as a controller: an ONNX model from what the sensors say to a target for every joint.

The model says in its metadata what it takes and gives; units are in the names. All of that is checked when it is made.
"""

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from snakesim_gnc.control.controller import Action, Report, View, positions
from snakesim_gnc.control.observations import Observer, Part, chosen, parts_of
from snakesim_hal.base.errors import ConfigError, did_you_mean, short
from snakesim_hal.model.files import SHIPPED, FileStruct, expanded
from snakesim_hal.model.plugins import pip_install
from snakesim_hal.model.textfiles import read_bytes
from snakesim_hal.wire.messages import Description, Mode
from snakesim_hal.wire.quantities import about
from snakesim_hal.wire.setpoints import RequestedSetpoints

RUNTIME: Any = None
with contextlib.suppress(ModuleNotFoundError):  # as this file is loaded: an arming, which makes the policy, cannot wait
    import onnxruntime

    RUNTIME = onnxruntime

OBSERVATIONS, ACTION = "snakesim.observations", "snakesim.action"
JOINTS, FRAME_SKIP = "snakesim.joints", "snakesim.frame_skip"
MODES = {"position": Mode.POSITION, "velocity": Mode.VELOCITY, "torque": Mode.TORQUE}
MAX_FRAME_SKIP = 1000
POLICIES, SUFFIX = SHIPPED / "policies", ".onnx"


class Model:
    """A model from a file, and what its metadata say. Callable: an observation in, targets out."""

    def __init__(self, robot: Description, file: str) -> None:
        """Raises ConfigError that names the file, the field, its value and what is expected."""
        self._session, given = opened(file)
        fields = _Metadata(file, given)
        self.parts = fields.parts(robot)
        self.action = fields.one_of(ACTION, MODES)
        self.frame_skip = fields.whole(FRAME_SKIP, MAX_FRAME_SKIP, "ticks")
        count = len(robot.joints)
        joints = fields.whole(JOINTS)
        if joints != count:
            raise fields.wrong(JOINTS, joints, f"{count}, the number of joints of robot {robot.robot!r}")
        for joint in robot.joints:
            if not joint.has(MODES[self.action]):
                has = [name for name, mode in MODES.items() if joint.has(mode)]
                raise fields.wrong(ACTION, self.action, f"what {joint.name} can do: {', '.join(has)}")
            if "torque_nm" in self.parts and "torque" not in joint.measures:
                raise fields.wrong(OBSERVATIONS, ",".join(self.parts), f"without torque_nm: {joint.name} measures none")
        width = sum(len(part.names) for part in self.parts.values())
        self._input = _only("input", self._session.get_inputs(), width, ", ".join(self.parts), file)
        self._output = _only("output", self._session.get_outputs(), count, "a target for each joint", file)

    def __call__(self, observation: NDArray[np.float32]) -> list[float]:
        return self._session.run([self._output], {self._input: observation[None]})[0][0].tolist()


class Policy:
    """Asks the model every `snakesim.frame_skip` ticks, and holds its targets meanwhile."""

    NEEDS, SENSES = "joints", True

    class Settings(FileStruct, frozen=True, kw_only=True):
        """The model."""

        model: Annotated[str, Meta(min_length=1, max_length=1024), about("shipped name, or path of an ONNX file")]

    def __init__(self, robot: Description, settings: Settings) -> None:
        """Raises ConfigError for a model that does not fit."""
        self._model = Model(robot, settings.model)
        self._observer = Observer(robot, self._model.parts)
        self._mode = MODES[self._model.action]
        self._robot = robot
        self._held: RequestedSetpoints | None = None  # setpoints while a sensor is silent
        self._torque_limit_nm = [joint.torque_limit_nm for joint in robot.joints]
        self._target: list[float] | None = None
        self._asked = 0  # the tick of the last question

    @staticmethod
    def check(robot: Description, settings: Settings) -> None:
        """Before a run begins. Raises ConfigError for a model that does not fit."""
        Model(robot, settings.model)

    def update(self, view: View) -> Action:
        """The model's targets; the limiter limits them. It holds its pose while a sensor that it needs is silent."""
        late = {} if view.senses is None else view.senses.late
        if why := "; ".join(late[key] for key in sorted(self._observer.sensors & late.keys())):
            self._held = self._held or positions(self._robot, view.joints.angle_rad)
            self._target = None
            return Action(self._held, Report(why=why))
        self._held = None
        if self._target is None or view.tick - self._asked >= self._model.frame_skip:
            self._target, self._asked = self._model(self._observer.update(view)), view.tick
        points = RequestedSetpoints([self._mode] * len(self._target), list(self._target), list(self._torque_limit_nm))
        reference = self._target if self._mode is Mode.POSITION else ()
        return Action(points, Report(why="a policy moves the joints", reference_rad=reference))


class _Metadata:
    """The metadata properties of a model, as texts."""

    def __init__(self, file: str, given: Mapping[str, str]) -> None:
        self._file, self._given = short(file), given

    def parts(self, robot: Description) -> dict[str, Part]:
        """The observation's parts, in order."""
        there = parts_of(robot)
        wanted = f"names out of {', '.join(there)}, each once, with commas between"
        text = self._text(OBSERVATIONS, wanted)
        parts = [part.strip() for part in text.split(",")]
        if not set(parts) <= set(there) or len(set(parts)) < len(parts):
            raise self.wrong(OBSERVATIONS, text, wanted)
        try:
            return chosen(robot, parts)
        except ConfigError as error:
            raise ConfigError(f"{self._file}: metadata `{OBSERVATIONS}` is {short(text)!r}: {error}") from None

    def one_of(self, field: str, allowed: Mapping[str, Any]) -> str:
        wanted = f"one of {', '.join(allowed)}"
        text = self._text(field, wanted).strip()
        if text not in allowed:
            raise self.wrong(field, text, wanted)
        return text

    def whole(self, field: str, most: int | None = None, unit: str = "") -> int:
        wanted = f"a whole number{f' of {unit}' if unit else ''} from 1{f' to {most}' if most else ''}"
        text = self._text(field, wanted).strip()
        if not (text.isascii() and text.isdigit() and len(text) < 10 and 1 <= int(text) <= (most or int(text))):
            raise self.wrong(field, text, wanted)
        return int(text)

    def wrong(self, field: str, value: object, wanted: str) -> ConfigError:
        return ConfigError(f"{self._file}: metadata `{field}` is {short(str(value))!r}, must be {wanted}")

    def _text(self, field: str, wanted: str) -> str:
        if field not in self._given:
            there = ", ".join(sorted(self._given)) or "no metadata"
            raise ConfigError(
                f"{self._file}: has no metadata `{field}`, which must be {wanted}; there is {short(there, 200)}"
            )
        return self._given[field]


def _path_of(name: str) -> Path:
    """Of a file, or of a shipped policy by its name."""
    if "/" in name or name.endswith(SUFFIX):
        return expanded(name)
    there = sorted(path.stem for path in POLICIES.glob(f"*{SUFFIX}"))
    if name not in there:
        raise ConfigError(
            f"no policy called {short(name)!r}; {did_you_mean(name, there)}shipped are {', '.join(there)}. For a file "
            f"of your own give its path, such as ./{short(name)}{SUFFIX}"
        )
    return POLICIES / f"{name}{SUFFIX}"


def opened(file: str) -> tuple[Any, Mapping[str, str]]:
    """A session with the model of a file, and its metadata."""
    data = read_bytes(_path_of(file))
    if RUNTIME is None:
        raise ConfigError(f"controller policy needs onnxruntime: {pip_install('policy')}")
    options = RUNTIME.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # the same sums in the same order, whatever the CPU
    options.log_severity_level = 3  # errors are raised, and told once
    try:
        session = RUNTIME.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # of many kinds, which have no name in common
        raise ConfigError(f"{short(file)}: cannot be loaded as an ONNX model: {short(str(error), 300)}") from error
    return session, session.get_modelmeta().custom_metadata_map


def _only(what: str, found: Sequence[Any], width: int, of: str, file: str) -> str:
    """The name of a model's one input or output, if it is float32 of shape (1, width); the 1 may be left open."""
    names = [f"{one.name} {one.type} {tuple(one.shape)}" for one in found]
    fits = len(found) == 1 and found[0].type == "tensor(float)" and len(found[0].shape) == 2
    first, second = found[0].shape if fits else (None, None)
    if not fits or second != width or (isinstance(first, int) and first != 1):
        there = short("; ".join(names) or "none", 200)
        raise ConfigError(
            f"{short(file)}: {what} is {there}, must be one tensor(float), that is float32, of shape (1, {width}): {of}"
        )
    return found[0].name
