"""What a browser may say to the console; everything else is dropped before viser sees it.

viser believes its pages: a message may set any attribute of a control that all viewers share. So a message has to be of
a known type with known fields, for a control that was admitted for this viewer, and has to carry the one value that the
control is there for. Whatever a later viser adds is refused until it is written down here. What is passed on is encoded
anew from what was checked.
"""

import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import msgspec
import viser
from msgspec import Meta, Struct

from snakesim_hal.terminal import printable

Identifier = Annotated[str, Meta(max_length=64)]
Text = Annotated[str, Meta(max_length=500)]
Number = Annotated[float, Meta(ge=-1e9, le=1e9)]  # which refuses NaN as well
Pixels = Annotated[float, Meta(ge=0, le=100_000)]
Vector = tuple[Number, Number, Number]
HandleT = TypeVar("HandleT")
LONGEST_SHOWN = 200


class _Message(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type"):
    pass


class Camera(_Message, frozen=True, tag="ViewerCameraMessage"):
    """Where the viewer looks from."""

    wxyz: tuple[Number, Number, Number, Number]
    position: Vector
    fov: Number
    near: Number
    far: Number
    image_height: Pixels
    image_width: Pixels
    look_at: Vector
    up_direction: Vector


class Value(Struct, frozen=True, forbid_unknown_fields=True):
    """Of a control."""

    value: bool | int | Number | Text


class Update(_Message, frozen=True, tag="GuiUpdateMessage"):
    """A control has another value, or a button was pressed."""

    uuid: Identifier
    updates: Value


class Hold(_Message, frozen=True, tag="GuiButtonHoldMessage"):
    """A button is held; repeated at that frequency."""

    uuid: Identifier
    frequency: Number


class Trigger(_Message, frozen=True, tag="CommandTriggerMessage"):
    """The key of a command was pressed."""

    uuid: Identifier


class Shown(_Message, frozen=True, tag="LocalStorageGetItemResponseMessage"):
    """The answer that `pacing` asks for."""

    request_uuid: Identifier
    value: Text | None
    error: Text | None


Said = Update | Hold | Trigger


@dataclass(frozen=True)
class _Control:
    name: str
    viewer: int | None  # None: every viewer has it
    may: Callable[[], bool]
    takes: Callable[[Said], bool]


class Admission:
    """The controls that viewers may use, each with its value. From any thread."""

    def __init__(self, report: Callable[[str], None] = lambda _: None) -> None:
        """report: told once of each kind of refusal."""
        self.report = report
        self.dropped: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._controls: dict[str, _Control] = {}
        self._decoder: msgspec.msgpack.Decoder[Camera | Said | Shown] = msgspec.msgpack.Decoder(Camera | Said | Shown)

    def admit(
        self, handle: HandleT, viewer: int | None = None, may: Callable[[], bool] = lambda: True, hold_hz: float = 0.0
    ) -> HandleT:
        """Let viewers use a control; returns it. viewer: who alone has it; may: whether now; hold_hz: of a button."""
        control: Any = handle
        name = control.label if isinstance(control, viser.GuiButtonHandle) else type(handle).__name__
        with self._lock:
            self._controls[control._impl.uuid] = _Control(str(name), viewer, may, _takes(control, hold_hz))
        return handle

    def forget(self, handle: Any) -> None:
        """A control is no longer there."""
        with self._lock:
            self._controls.pop(handle._impl.uuid, None)

    def forget_viewer(self, viewer: int) -> None:
        """A viewer's page is gone."""
        with self._lock:
            self._controls = {key: one for key, one in self._controls.items() if one.viewer != viewer}

    def checked(self, viewer: int | None, data: bytes | str) -> bytes | None:
        """What viser may read of a message; None drops it."""
        if viewer is None or isinstance(data, str):
            return self.drop(viewer, "no message", "a text, or of no viewer")
        try:
            message = self._decoder.decode(data)
        except (msgspec.DecodeError, RecursionError) as error:  # a ValidationError too
            return self.drop(viewer, "unknown", str(error))
        if isinstance(message, Update | Hold | Trigger):
            with self._lock:
                control = self._controls.get(message.uuid)
            if control is None or control.viewer not in (None, viewer):
                return self.drop(viewer, "no control of this viewer", type(message).__name__)
            if not control.may():
                return self.drop(viewer, "without control of the robot", control.name)
            if not control.takes(message):
                return self.drop(viewer, "not what the control is for", f"{control.name}: {message}")
        return msgspec.msgpack.encode(message)

    def drop(self, viewer: int | None, kind: str, what: str) -> None:
        """Count a message that is not passed on, and report the first of its kind."""
        with self._lock:
            self.dropped[kind] += 1
            first = self.dropped[kind] == 1
        if first:
            who = "a page" if viewer is None else f"viewer {viewer + 1}"
            self.report(f"dropped a message of {who}: {kind}: {printable(what)[:LONGEST_SHOWN]}; more are only counted")


def _takes(handle: Any, hold_hz: float) -> Callable[[Said], bool]:
    """Whether a message is what a control is for. Raises TypeError for a kind of control that is not known here."""
    match handle:
        case viser.CommandHandle():
            return lambda said: isinstance(said, Trigger)
        case viser.GuiButtonHandle():
            return lambda said: (
                said.updates.value is True
                if isinstance(said, Update)
                else isinstance(said, Hold) and hold_hz > 0 and said.frequency == hold_hz
            )
        case viser.GuiCheckboxHandle():
            return _value(lambda value: isinstance(value, bool))
        case viser.GuiTextHandle():
            return _value(lambda value: isinstance(value, str))
        case viser.GuiDropdownHandle() | viser.GuiButtonGroupHandle():
            options = frozenset(handle.options)
            return _value(lambda value: isinstance(value, str) and value in options)
        case viser.GuiSliderHandle() | viser.GuiNumberHandle():
            whole, low, high = isinstance(handle.value, int), handle.min, handle.max
            return _value(
                lambda value: (
                    isinstance(value, int if whole else int | float)
                    and not isinstance(value, bool)
                    and (low is None or value >= low)
                    and (high is None or value <= high)
                )
            )
    raise TypeError(f"{type(handle).__name__}: which values viewers may give it is not known")


def _value(right: Callable[[Any], bool]) -> Callable[[Said], bool]:
    return lambda said: isinstance(said, Update) and right(said.updates.value)
