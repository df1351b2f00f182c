"""A controller's settings as sliders and boxes, made from its own schema.

The schema comes from the network: it decides what is shown, and nothing else; control checks every value again.
"""

import math
from dataclasses import dataclass
from typing import Any

import msgspec
import viser

from snakesim_hal.wire.messages import ControlSettings
from snakesim_operator.robot_commands.parameters import Parameter, parameters_of


@dataclass(frozen=True)
class InputField:
    """One setting. A number has a range that is sensible to slide over: about its value, and within its bounds."""

    name: str
    value: bool | int | float | str
    unit: str = ""
    choices: tuple[str, ...] = ()
    low: float = 0.0
    high: float = 0.0
    step: float = 0.0
    hint: str = ""


def list_input_fields(settings: ControlSettings) -> list[InputField]:
    """The settings that can be changed here; others keep their value. Nothing for a schema that cannot be read."""
    found = [_field(parameter) for parameter in parameters_of(settings)]
    return [field for field in found if field is not None]


def _field(of: Parameter) -> InputField | None:
    name, value = of.name, of.value
    hint = "; ".join(filter(None, (of.about, of.range and f"{of.range} {of.unit}".removesuffix(" 1").strip())))
    if isinstance(value, bool):
        return InputField(name, value, hint=of.about)
    if isinstance(value, str) and value in of.choices:
        return InputField(name, value, choices=of.choices, hint=of.about)
    if not isinstance(value, int | float) or not math.isfinite(value):
        return None
    reach = 4.0 * abs(value) or 1.0
    low = -reach if of.least is None else max(of.least, -reach)
    high = reach if of.most is None else min(of.most, reach)
    step = 1.0 if isinstance(value, int) else 10.0 ** math.floor(math.log10(max(high - low, 1e-9) / 100))
    if of.above_least and low == of.least:
        low += step
    return InputField(name, value, of.unit, low=min(low, value), high=max(high, value), step=step, hint=hint)


class SettingsForm:
    """The inputs of one viewer."""

    def __init__(self, gui: viser.GuiApi, folder: viser.GuiFolderHandle, settings: ControlSettings) -> None:
        self.controller = settings.controller
        self._values: dict[str, Any] = msgspec.json.decode(settings.settings, type=dict[str, Any])
        self._inputs: dict[str, Any] = {}
        with folder:
            for field in list_input_fields(settings):
                self._inputs[field.name] = _input(gui, field)

    @property
    def inputs(self) -> list[Any]:
        """What the viewer can set."""
        return list(self._inputs.values())

    def enable(self, enabled: bool) -> None:
        """Whether the viewer may change them."""
        for one in self._inputs.values():
            one.disabled = not enabled

    def asked(self) -> str:
        """All settings as JSON, with what the viewer has set."""
        return msgspec.json.encode({**self._values, **{name: one.value for name, one in self._inputs.items()}}).decode()

    def show(self, settings: ControlSettings) -> bool:
        """Show the values in force; False when they are of another controller, and the form does not fit."""
        if settings.controller != self.controller:
            return False
        self._values = msgspec.json.decode(settings.settings, type=dict[str, Any])
        for name, one in self._inputs.items():
            if name in self._values:
                one.value = self._values[name]
        return True

    def remove(self) -> None:
        """Take it off the page."""
        for one in self._inputs.values():
            one.remove()


def _input(gui: viser.GuiApi, field: InputField) -> Any:
    label = f"{field.name}, {field.unit}" if field.unit not in ("", "1") else field.name
    if isinstance(field.value, bool):
        return gui.add_checkbox(label, field.value, hint=field.hint)
    if isinstance(field.value, str):
        return gui.add_dropdown(label, field.choices, initial_value=field.value, hint=field.hint)
    if isinstance(field.value, int):
        return gui.add_number(label, field.value, min=math.ceil(field.low), step=1, hint=field.hint)
    return gui.add_slider(label, field.low, field.high, field.step, field.value, hint=field.hint)
