"""The base class of controllers: its defaults, the declarations of subclasses, and refusals of other classes."""

import inspect
import re
from pathlib import Path
from typing import Any

import msgspec
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.controller import (
    Controller,
    ControllerCommand,
    NoParameters,
    Observation,
    decode_parameters,
    load_controller,
    make_position_setpoints,
)
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.plugins import CONTROLLERS, list_installed_plugins, require_base_class
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_hal.programs.preflight import validate_and_complete_config
from snakesim_testing.hal.small_robots import make_description, make_joint_state

SHIPPED_CONTROLLERS = list_installed_plugins(CONTROLLERS)
DECLARED = {name for name in vars(Controller) if not name.startswith("_")}
DECLARATIONS = DECLARED - {"check", "update"}


class HoldingController(Controller[NoParameters]):
    def update(self, observation: Observation) -> ControllerCommand:
        return ControllerCommand(make_position_setpoints(self.robot, observation.joints.angle_rad))


class GainParameters(FileStruct, frozen=True):
    gain: float = 1.0


class GainController(HoldingController):
    Parameters = GainParameters


def test_controller_with_update_alone_has_all_defaults() -> None:
    robot = make_description()
    controller = HoldingController(robot, NoParameters())
    assert controller.robot is robot
    assert controller.parameters == NoParameters()
    assert (controller.needs_world, controller.uses_sensors) == (True, False)
    assert controller.required_modes == ()
    assert controller.required_measurements == ()
    assert (
        decode_parameters(HoldingController, {}, "a.toml", "controllers.plain")
        == HoldingController.Parameters()
    )
    HoldingController.check(robot, NoParameters())
    command = controller.update(Observation(0, 0.0, 0.01, make_joint_state(robot), None, None))
    assert command.setpoints.target == list(make_joint_state(robot).angle_rad)


def test_controller_parameters_are_checked_by_struct_naming_file_or_flag() -> None:
    assert decode_parameters(GainController, {"gain": 2.0}, "a.toml", "controllers.p").gain == 2.0
    with pytest.raises(
        ConfigError, match=r"^a\.toml: unknown field `controllers\.p\.gian`; did you mean `gain`\?"
    ):
        decode_parameters(GainController, {"gian": 1}, "a.toml", "controllers.p")
    origin = {"controllers.p.gain": "--set control.gain=x"}
    with pytest.raises(ConfigError, match=r"^--set control\.gain=x: `controllers\.p\.gain` = 'x'"):
        decode_parameters(GainController, {"gain": "x"}, "a.toml", "controllers.p", origin)


def test_controller_parameters_that_are_no_struct_are_refused() -> None:
    class Odd(HoldingController):
        Parameters: Any = dict

    with pytest.raises(
        ConfigError,
        match=r"class Odd in .*test_controller\.py: `Parameters` is .*dict.*, must be a",
    ):
        decode_parameters(Odd, {}, "a.toml", "controllers.odd")


@pytest.mark.parametrize("name", SHIPPED_CONTROLLERS)
def test_shipped_controller_has_only_declarations_of_the_base_class(name: str) -> None:
    """Find misspelled declarations, which would have no effect."""
    for base_class in load_controller(name).__mro__:
        if base_class is Controller or not issubclass(base_class, Controller):
            continue
        attributes = {
            key for key, value in vars(base_class).items() if not inspect.isfunction(value)
        }
        unknown = {key for key in attributes if not key.startswith("_")} - DECLARED
        assert not unknown, (
            f"{base_class.__name__} declares {unknown}; Controller knows {DECLARATIONS}"
        )


@pytest.mark.parametrize("name", SHIPPED_CONTROLLERS)
def test_controller_shipped_declarations_have_types_of_base_class(name: str) -> None:
    controller = load_controller(name)
    assert issubclass(controller.Parameters, msgspec.Struct)
    for declaration in DECLARATIONS - {"Parameters"}:
        assert type(vars(Controller)[declaration]) is type(
            inspect.getattr_static(controller, declaration)
        ), declaration


def test_controller_base_class_documents_every_declaration() -> None:
    lines = inspect.getsource(Controller).splitlines()
    for declaration in DECLARATIONS:
        row = next(i for i, line in enumerate(lines) if line.startswith(f"    {declaration}: "))
        assert lines[row + 1].startswith('    """'), declaration
    assert all(vars(Controller)[method].__doc__ for method in ("check", "update", "__init__"))


FILE_WITHOUT_BASE_CLASS = """\
class Wave:
    def __init__(self, robot, parameters):
        self.robot = robot

    def update(self, observation):
        return None
"""
FILE_WITHOUT_UPDATE = """\
import snakesim

class Wave(snakesim.Controller):
    def updat(self, observation):
        return None
"""
INVALID_FILES = {
    "without the base class": (
        FILE_WITHOUT_BASE_CLASS,
        "class Wave in {file} does not derive from Controller. Write `class Wave(Controller):`, after "
        "`from snakesim_hal.controller import Controller`",
    ),
    "without update": (FILE_WITHOUT_UPDATE, "class Wave in {file} has no `update`"),
    "a function": ("def Wave(robot, parameters): ...\n", "the object <function Wave at "),
}


@pytest.mark.parametrize("case", INVALID_FILES)
def test_controller_preflight_refuses_other_classes_with_instructions(
    case: str, tmp_path: Path
) -> None:
    text, expected_text = INVALID_FILES[case]
    file = tmp_path / "wave.py"
    file.write_text(text)
    config = load_scenario("triplet", [parse_set_option(f"controller={file}:Wave")]).config
    with pytest.raises(ConfigError, match=re.escape(expected_text.format(file=file))) as refusal:
        validate_and_complete_config(config)
    assert str(refusal.value).startswith("controller '")
    assert "snakesim_hal.controller" in str(refusal.value)


def test_controller_preflight_calls_the_check_of_the_class(tmp_path: Path) -> None:
    (tmp_path / "picky.py").write_text(
        "from snakesim_gnc.control.hold import HoldPose\n"
        "from snakesim_hal.base.errors import ConfigError\n\n\n"
        "class Picky(HoldPose):\n"
        "    @classmethod\n"
        "    def check(cls, robot, parameters):\n"
        "        raise ConfigError(f'{cls.__name__} does not move {robot.robot}')\n"
    )
    config = load_scenario(
        "triplet", [parse_set_option(f"controller={tmp_path}/picky.py:Picky")]
    ).config
    with pytest.raises(ConfigError, match=r"^Picky does not move planar13$"):
        validate_and_complete_config(config)


def test_controller_class_without_file_is_named_by_module() -> None:
    with pytest.raises(
        ConfigError, match="class int in module builtins does not derive from Controller"
    ):
        require_base_class(int, Controller, "controller 'program:int'")
