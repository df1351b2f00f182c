"""A controller's settings as sliders and boxes, made from its own schema.

The schema comes from the network: it decides what is shown, and nothing else; control checks every value again.
"""

import json
import math
from dataclasses import dataclass
from typing import Any

import msgspec
import viser

from snakesim_hal.wire.messages import ControlSettings

MAX_FIELDS = 100
LONGEST_LABEL = 40


@dataclass(frozen=True)
class Field:
    """One setting. A number has a range that is sensible to slide over: about its value, and within its bounds."""

    name: str
    value: bool | int | float | str
    unit: str = ""
    choices: tuple[str, ...] = ()
    low: float = 0.0
    high: float = 0.0
    step: float = 0.0


def fields_of(settings: ControlSettings) -> list[Field]:
    """The settings that can be changed here; others keep their value. Nothing for a schema that cannot be read."""
    try:
        schema, values = json.loads(settings.schema), msgspec.json.decode(settings.settings, type=dict[str, Any])
        properties = _resolved(schema, schema)["properties"]
        described = [(name, _resolved(schema, properties.get(name, {})), value) for name, value in values.items()]
        found = [_field(name[:LONGEST_LABEL], of, value) for name, of, value in described[:MAX_FIELDS]]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, msgspec.DecodeError):
        return []
    return [field for field in found if field is not None]


def _resolved(schema: dict[str, Any], part: dict[str, Any]) -> dict[str, Any]:
    reference = part.get("$ref")
    return part if reference is None else schema["$defs"][reference.rpartition("/")[2]]


def _field(name: str, of: dict[str, Any], value: Any) -> Field | None:
    choices = of.get("enum")
    if isinstance(value, bool):
        return Field(name, value)
    if isinstance(value, str) and isinstance(choices, list) and value in choices:
        return Field(name, value, choices=tuple(str(choice) for choice in choices))
    if not isinstance(value, int | float) or not math.isfinite(value):
        return None
    least, most = _number(of, "minimum", "exclusiveMinimum"), _number(of, "maximum", "exclusiveMaximum")
    reach = 4.0 * abs(value) or 1.0
    low, high = max(-reach if least is None else least, -reach), min(reach if most is None else most, reach)
    step = 1.0 if isinstance(value, int) else 10.0 ** math.floor(math.log10(max(high - low, 1e-9) / 100))
    if low == of.get("exclusiveMinimum"):
        low += step
    unit = str(of.get("unit", ""))[:LONGEST_LABEL]
    return Field(name, value, unit, low=min(low, value), high=max(high, value), step=step)


def _number(of: dict[str, Any], *names: str) -> float | None:
    return next((float(of[name]) for name in names if isinstance(of.get(name), int | float)), None)


class SettingsForm:
    """The inputs of one viewer."""

    def __init__(self, gui: viser.GuiApi, folder: viser.GuiFolderHandle, settings: ControlSettings) -> None:
        self.controller = settings.controller
        self._values: dict[str, Any] = msgspec.json.decode(settings.settings, type=dict[str, Any])
        self._inputs: dict[str, Any] = {}
        with folder:
            for field in fields_of(settings):
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


def _input(gui: viser.GuiApi, field: Field) -> Any:
    label = f"{field.name}, {field.unit}" if field.unit not in ("", "1") else field.name
    if isinstance(field.value, bool):
        return gui.add_checkbox(label, field.value)
    if isinstance(field.value, str):
        return gui.add_dropdown(label, field.choices, initial_value=field.value)
    if isinstance(field.value, int):
        return gui.add_number(label, field.value, min=math.ceil(field.low), step=1)
    return gui.add_slider(label, field.low, field.high, field.step, field.value)
