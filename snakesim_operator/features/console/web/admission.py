"""Decides which messages of a browser viser gets to read; all others are dropped.

viser trusts its pages: a message may set any attribute of a control that all viewers share. Therefore a message has to
be of a known type with known fields. It has to be for a control that was admitted for this viewer, and has to carry the
one value that the control is there for. A message type that a later version of viser adds is refused until it is listed
here. viser gets a new encoding of the checked fields, never the browser's own bytes.

Messages that stop the robot, and messages that move it while a button is held, are handled here and never reach viser:
its queues and threads would add an unknown delay. Messages that move a robot are also checked for their age.
"""

import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

import msgspec
import viser
from msgspec import Meta, Struct

from snakesim_hal.base.terminal import escape_invisible
from snakesim_operator.features.console.web.message_age import MessageAge, PageAction

Identifier = Annotated[str, Meta(max_length=64)]
Text = Annotated[str, Meta(max_length=500)]
Number = Annotated[float, Meta(ge=-1e9, le=1e9)]  # these bounds refuse NaN as well
Pixels = Annotated[float, Meta(ge=0, le=100_000)]
Vector = tuple[Number, Number, Number]
HandleT = TypeVar("HandleT")

MAX_REPORTED_CHARACTERS = 200  # of a dropped message, so that a browser cannot fill the log
# Of a press that may move the robot: an older one was meant for another moment.
MAX_PRESS_AGE_S = 5.0
MAX_HOLD_AGE_S = 0.5  # of a message that a button or key is held: the finger may be up by now


class _ViewerMessage(
    Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type"
):
    pass


class ViewerCamera(_ViewerMessage, frozen=True, tag="ViewerCameraMessage"):
    """The position and direction from which a viewer looks at the scene."""

    wxyz: tuple[Number, Number, Number, Number]
    position: Vector
    fov: Number
    near: Number
    far: Number
    image_height: Pixels
    image_width: Pixels
    look_at: Vector
    up_direction: Vector


class ControlValue(Struct, frozen=True, forbid_unknown_fields=True):
    """The one attribute of a control that a browser may set."""

    value: bool | int | Number | Text


class UpdateMessage(_ViewerMessage, frozen=True, tag="GuiUpdateMessage"):
    """A control has another value, or a button was pressed."""

    uuid: Identifier
    updates: ControlValue


class HoldMessage(_ViewerMessage, frozen=True, tag="GuiButtonHoldMessage"):
    """A button is held; repeated at that frequency."""

    uuid: Identifier
    frequency: Number


class TriggerMessage(_ViewerMessage, frozen=True, tag="CommandTriggerMessage"):
    """The key of a command was pressed."""

    uuid: Identifier


class QuestionAnswer(_ViewerMessage, frozen=True, tag="LocalStorageGetItemResponseMessage"):
    """A page's answer to a question of `pacing`."""

    request_uuid: Identifier
    value: Text | None
    error: Text | None


ControlMessage = UpdateMessage | HoldMessage | TriggerMessage
Handler = Callable[[int, PageAction], None]  # called with the viewer and the time of the action


@dataclass(frozen=True)
class _AdmittedControl:
    """A control, and the rules for the messages that may change it."""

    name: str
    viewer: int | None  # the only viewer that has it; None: every viewer has it
    is_allowed: Callable[[], bool]
    accepts: Callable[[ControlMessage], bool]
    handler: Handler | None
    max_age_s: float
    at_any_age: frozenset[str]
    on_late: Callable[[float], None]

    def is_late(self, message: ControlMessage, action: PageAction) -> bool:
        """Return whether a message is too old to be handled."""
        if isinstance(message, UpdateMessage) and message.updates.value in self.at_any_age:
            return False
        return action.age_s > self.max_age_s


class ControlAdmission:
    """Holds the controls that viewers may use, and checks each message of a browser. Thread-safe."""

    def __init__(self, report: Callable[[str], None] = lambda _: None) -> None:
        """Start without controls. `report` is called with a text for the first dropped message of each kind."""
        self.report = report
        self.dropped: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._controls: dict[str, _AdmittedControl] = {}
        self._decoder: msgspec.msgpack.Decoder[ViewerCamera | ControlMessage | QuestionAnswer] = (
            msgspec.msgpack.Decoder(ViewerCamera | ControlMessage | QuestionAnswer)
        )

    def admit_control(
        self,
        handle: HandleT,
        viewer_id: int | None = None,
        is_allowed: Callable[[], bool] = lambda: True,
        hold_hz: float = 0.0,
        *,
        handler: Handler | None = None,
        max_age_s: float = math.inf,
        at_any_age: Collection[str] = (),
        on_late: Callable[[float], None] = lambda _age_s: None,
    ) -> HandleT:
        """Let viewers use a control.

        Args:
            handle: The control.
            viewer_id: The only viewer that may use the control; None for every viewer.
            is_allowed: Returns whether the control may be used now.
            hold_hz: Rate at which the page repeats that a button is held; 0 for other controls.
            handler: Called for each message that is admitted, in the thread that receives: it must not wait. None:
                viser gets the message.
            max_age_s: An older message is dropped.
            at_any_age: Values of the control that are never too old, because they stop something.
            on_late: Called with the age of a message that is dropped because of its age.

        Returns:
            The control.

        Raises:
            TypeError: The valid values of this kind of control are not known.
        """
        control: Any = handle
        if isinstance(control, viser.GuiButtonHandle | viser.CommandHandle):
            name = str(control.label)
        else:
            name = type(handle).__name__
        admitted = _AdmittedControl(
            name=name,
            viewer=viewer_id,
            is_allowed=is_allowed,
            accepts=_make_message_validator(control, hold_hz),
            handler=handler,
            max_age_s=max_age_s,
            at_any_age=frozenset(at_any_age),
            on_late=on_late,
        )
        with self._lock:
            self._controls[control._impl.uuid] = admitted
        return handle

    def remove_control(self, handle: Any) -> None:
        """Refuse messages for a control from now on, because it is removed from the page."""
        with self._lock:
            self._controls.pop(handle._impl.uuid, None)

    def remove_viewer(self, viewer_id: int) -> None:
        """Forget all controls of a viewer whose page is closed."""
        with self._lock:
            self._controls = {
                uuid: control
                for uuid, control in self._controls.items()
                if control.viewer != viewer_id
            }

    def filter_message(
        self, viewer_id: int | None, data: bytes | str, age: MessageAge
    ) -> bytes | None:
        """Check a message of a browser, and handle it here if its control has a handler.

        A message is dropped and counted if it cannot be decoded, if its control does not allow it, or if it is too old.

        Args:
            viewer_id: Client id of the viewer that sent the message; None while viser has not numbered the viewer.
            data: The message as it was received.
            age: Measures how old the messages of this page are.

        Returns:
            The message that is passed on to viser, encoded anew; None if it was dropped or handled here.
        """
        if viewer_id is None or isinstance(data, str):
            self.count_dropped_message(viewer_id, "no message", "a text, or of no viewer")
            return None
        try:
            message = self._decoder.decode(data)
        except (msgspec.DecodeError, RecursionError) as error:  # a ValidationError is a DecodeError
            self.count_dropped_message(viewer_id, "unknown", str(error))
            return None
        if isinstance(message, QuestionAnswer):
            age.note_answer(message.request_uuid)
        elif isinstance(message, UpdateMessage | HoldMessage | TriggerMessage):
            control = self._find_control(viewer_id, message)
            if control is None:
                return None
            action = age.date_action(time.monotonic())
            if control.is_late(message, action):
                control.on_late(action.age_s)
                self.count_dropped_message(
                    viewer_id, "too old", f"{control.name}: {format_age(action.age_s)}"
                )
                return None
            if control.handler is not None:
                control.handler(viewer_id, action)
                return None
        return msgspec.msgpack.encode(message)

    def _find_control(self, viewer_id: int, message: ControlMessage) -> _AdmittedControl | None:
        """Return the control that a viewer may change now with this message; None if the message was dropped."""
        with self._lock:
            control = self._controls.get(message.uuid)
        if control is None or control.viewer not in (None, viewer_id):
            self.count_dropped_message(
                viewer_id, "no control of this viewer", type(message).__name__
            )
            return None
        if not control.is_allowed():
            self.count_dropped_message(viewer_id, "without control of the robot", control.name)
            return None
        if not control.accepts(message):
            self.count_dropped_message(
                viewer_id, "not what the control is for", f"{control.name}: {message}"
            )
            return None
        return control

    def count_dropped_message(self, viewer_id: int | None, kind: str, detail: str) -> None:
        """Count a message or connection that is not passed on, and report the first of its kind."""
        with self._lock:
            self.dropped[kind] += 1
            is_first = self.dropped[kind] == 1
        if is_first:
            sender = "a page" if viewer_id is None else f"viewer {viewer_id + 1}"
            shown = escape_invisible(detail)[:MAX_REPORTED_CHARACTERS]
            self.report(f"dropped a message of {sender}: {kind}: {shown}; more are only counted")


def format_age(age_s: float) -> str:
    """Return the age of a message as a phrase for the viewer."""
    if math.isinf(age_s):
        return "its age is not known: the page has not answered yet"
    return f"it came {age_s:.1f} s late"


def _make_message_validator(control: Any, hold_hz: float) -> Callable[[ControlMessage], bool]:
    """Return a function that reports whether a message is valid for a control of the page.

    Args:
        control: The control, as viser has it; its type, options and bounds decide which values are valid.
        hold_hz: Rate at which the page may repeat that a button is held; 0 if a hold is not allowed.

    Raises:
        TypeError: The control is of a kind for which the valid values are not known.
    """
    match control:
        case viser.CommandHandle():
            return lambda message: isinstance(message, TriggerMessage)
        case viser.GuiButtonHandle():
            return lambda message: _is_press_or_hold(message, hold_hz)
        case viser.GuiCheckboxHandle():
            return _make_value_validator(lambda value: isinstance(value, bool))
        case viser.GuiTextHandle():
            return _make_value_validator(lambda value: isinstance(value, str))
        case viser.GuiDropdownHandle() | viser.GuiButtonGroupHandle():
            options = frozenset(control.options)
            return _make_value_validator(lambda value: isinstance(value, str) and value in options)
        case viser.GuiSliderHandle() | viser.GuiNumberHandle():
            number_types = (int,) if isinstance(control.value, int) else (int, float)
            min_value = control.min
            max_value = control.max
            return _make_value_validator(
                lambda value: _is_number_within(value, number_types, min_value, max_value)
            )
    raise TypeError(f"{type(control).__name__}: which values viewers may give it is not known")


def _make_value_validator(is_valid: Callable[[Any], bool]) -> Callable[[ControlMessage], bool]:
    """Return a function that accepts updates whose value is valid, and no other messages."""
    return lambda message: isinstance(message, UpdateMessage) and is_valid(message.updates.value)


def _is_press_or_hold(message: ControlMessage, hold_hz: float) -> bool:
    """Return whether a button was pressed, or is held and repeats that at `hold_hz` (0: it cannot be held)."""
    if isinstance(message, UpdateMessage):
        return message.updates.value is True
    return isinstance(message, HoldMessage) and hold_hz > 0 and message.frequency == hold_hz


def _is_number_within(
    value: Any, number_types: tuple[type, ...], min_value: float | None, max_value: float | None
) -> bool:
    if isinstance(value, bool) or not isinstance(value, number_types):
        return False
    is_above_low = min_value is None or value >= min_value
    is_below_high = max_value is None or value <= max_value
    return is_above_low and is_below_high
