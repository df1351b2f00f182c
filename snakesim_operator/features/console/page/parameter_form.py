"""A controller's parameters as sliders and boxes, made from the controller's own schema.

The schema comes from the network. It decides which inputs are shown, and nothing else: control checks every value
again.
"""

import math
from dataclasses import dataclass
from typing import Any

import msgspec
import viser

from snakesim_hal.wire.messages import ControlParameters
from snakesim_operator.robot_commands.parameters import RobotParameter, parse_parameters


@dataclass(frozen=True)
class InputField:
    """The input for one parameter. A number has a range that is sensible to slide over."""

    name: str
    value: bool | int | float | str
    unit: str = ""
    choices: tuple[str, ...] = ()
    low: float = 0.0
    high: float = 0.0
    step: float = 0.0
    hint: str = ""


def list_input_fields(in_force: ControlParameters) -> list[InputField]:
    """Return the inputs for the parameters that a form can change; empty for a schema that cannot be read."""
    fields: list[InputField] = []
    for parameter in parse_parameters(in_force):
        field = _make_field(parameter)
        if field is not None:
            fields.append(field)
    return fields


def _make_field(parameter: RobotParameter) -> InputField | None:
    """Make the input field for a parameter; return None if its type has no input."""
    value = parameter.value
    if isinstance(value, bool):
        return InputField(parameter.name, value, hint=parameter.description)
    if isinstance(value, str) and value in parameter.choices:
        return InputField(
            parameter.name, value, choices=parameter.choices, hint=parameter.description
        )
    if isinstance(value, int | float) and math.isfinite(value):
        return _make_number_field(parameter, value)
    return None


def _make_number_field(parameter: RobotParameter, value: float) -> InputField:
    """Make the input field for a number, with the range and the step of its slider.

    It allows numbers up to four times the current value in both directions, as far as the parameter's bounds allow.

    Args:
        parameter: Name, unit and bounds of the parameter.
        value: Current value of the parameter. An integer gets steps of 1.
    """
    max_magnitude = 4.0 * abs(value) or 1.0
    slider_min = -max_magnitude
    if parameter.minimum is not None:
        slider_min = max(parameter.minimum, -max_magnitude)
    slider_max = max_magnitude
    if parameter.maximum is not None:
        slider_max = min(parameter.maximum, max_magnitude)
    step = 1.0
    if not isinstance(value, int):
        # The power of ten that divides the range into 100 to 1000 steps.
        step = 10.0 ** math.floor(math.log10(max(slider_max - slider_min, 1e-9) / 100))
    if parameter.excludes_minimum and slider_min == parameter.minimum:
        slider_min += step  # the bound itself is not allowed
    return InputField(
        parameter.name,
        value,
        parameter.unit,
        low=min(slider_min, value),
        high=max(slider_max, value),
        step=step,
        hint=_describe_number(parameter),
    )


def _describe_number(parameter: RobotParameter) -> str:
    """Return description, bounds and unit of a parameter, as far as it has them."""
    parts: list[str] = []
    if parameter.description:
        parts.append(parameter.description)
    if parameter.range_text:
        parts.append(f"{parameter.range_text} {parameter.unit}".removesuffix(" 1").strip())
    return "; ".join(parts)


class ParameterForm:
    """The inputs of one viewer for the parameters of one controller."""

    def __init__(
        self, gui: viser.GuiApi, folder: viser.GuiFolderHandle, in_force: ControlParameters
    ) -> None:
        self.controller = in_force.controller
        self._values = _decode_values(in_force)
        self._inputs: dict[str, Any] = {}  # handles of viser, by the parameter's name
        with folder:
            for field in list_input_fields(in_force):
                self._inputs[field.name] = _add_input(gui, field)

    @property
    def inputs(self) -> list[Any]:
        """The inputs, as handles of viser."""
        return list(self._inputs.values())

    def set_enabled(self, enabled: bool) -> None:
        """Set whether the viewer may change the inputs."""
        for control in self._inputs.values():
            control.disabled = not enabled

    def encode_parameters(self) -> str:
        """Return all parameters as JSON, with the values that the viewer has entered."""
        entered = {name: control.value for name, control in self._inputs.items()}
        return msgspec.json.encode({**self._values, **entered}).decode()

    def show_values(self, in_force: ControlParameters) -> bool:
        """Show the values in force, and return whether this form is for their controller."""
        if in_force.controller != self.controller:
            return False
        self._values = _decode_values(in_force)
        for name, control in self._inputs.items():
            if name in self._values:
                control.value = self._values[name]
        return True

    def remove(self) -> None:
        """Remove the inputs from the page."""
        for control in self._inputs.values():
            control.remove()


def _decode_values(in_force: ControlParameters) -> dict[str, Any]:
    return msgspec.json.decode(in_force.parameters, type=dict[str, Any])


def _add_input(gui: viser.GuiApi, field: InputField) -> Any:
    """Add the input for a field to the page, and return its handle."""
    label = field.name
    if field.unit not in ("", "1"):
        label = f"{field.name}, {field.unit}"
    match field.value:
        case bool():
            return gui.add_checkbox(label, field.value, hint=field.hint)
        case str():
            return gui.add_dropdown(
                label, field.choices, initial_value=field.value, hint=field.hint
            )
        case int():
            return gui.add_number(
                label, field.value, min=math.ceil(field.low), step=1, hint=field.hint
            )
        case _:
            return gui.add_slider(
                label, field.low, field.high, field.step, field.value, hint=field.hint
            )
