"""What a browser may say to the console; everything else is dropped before viser sees it.

viser believes its pages: a message may set any attribute of a control that all viewers share. So a message has to be of
a known type with known fields, for a control that was admitted for this viewer, and has to carry the one value that the
control is there for. Whatever a later viser adds is refused until it is written down here. What is passed on is encoded
anew from what was checked.

What stops a robot, and what moves it while it is held, is acted on here and never reaches viser, whose queues and
threads would add a delay that nobody knows. What a page says in order to move a robot is checked for its age as well.
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

from snakesim_hal.base.terminal import printable
from snakesim_operator.features.console.web.message_age import MessageAge, PageAction

Identifier = Annotated[str, Meta(max_length=64)]
Text = Annotated[str, Meta(max_length=500)]
Number = Annotated[float, Meta(ge=-1e9, le=1e9)]  # which refuses NaN as well
Pixels = Annotated[float, Meta(ge=0, le=100_000)]
Vector = tuple[Number, Number, Number]
HandleT = TypeVar("HandleT")
LONGEST_SHOWN = 200
MAX_PRESS_AGE_S = 5.0  # of a press that may move the robot: an older one was meant for another moment
MAX_HOLD_AGE_S = 0.5  # of a sign that something is held


class _Message(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="type"):
    pass


class ViewerCamera(_Message, frozen=True, tag="ViewerCameraMessage"):
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
Act = Callable[[int, PageAction], None]  # of which viewer, and when


@dataclass(frozen=True)
class _Control:
    name: str
    viewer: int | None  # None: every viewer has it
    may: Callable[[], bool]
    takes: Callable[[Said], bool]
    act: Act | None
    max_age_s: float
    at_any_age: frozenset[str]
    on_late: Callable[[float], None]

    def is_late(self, said: Said, action: PageAction) -> bool:
        """Whether a message is too old to be acted on."""
        if isinstance(said, Update) and said.updates.value in self.at_any_age:
            return False
        return action.age_s > self.max_age_s


class Admission:
    """The controls that viewers may use, each with its value. From any thread."""

    def __init__(self, report: Callable[[str], None] = lambda _: None) -> None:
        """report: told once of each kind of refusal."""
        self.report = report
        self.dropped: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._controls: dict[str, _Control] = {}
        self._decoder: msgspec.msgpack.Decoder[ViewerCamera | Said | Shown] = msgspec.msgpack.Decoder(
            ViewerCamera | Said | Shown
        )

    def admit(
        self,
        handle: HandleT,
        viewer: int | None = None,
        may: Callable[[], bool] = lambda: True,
        hold_hz: float = 0.0,
        *,
        act: Act | None = None,
        max_age_s: float = math.inf,
        at_any_age: Collection[str] = (),
        on_late: Callable[[float], None] = lambda _age_s: None,
    ) -> HandleT:
        """Let viewers use a control.

        Args:
            handle: The control.
            viewer: Who alone has it; None: every viewer.
            may: Whether it may be used now.
            hold_hz: How often its page repeats that it is held, for a button.
            act: Called for each message that is admitted, in the thread that receives: it must not wait. None: viser
                gets the message.
            max_age_s: An older message is dropped.
            at_any_age: Values of the control that are never too old, because they stop something.
            on_late: Called with the age of a message that is dropped for it.

        Returns:
            The control.
        """
        control: Any = handle
        named = isinstance(control, viser.GuiButtonHandle | viser.CommandHandle)
        name = control.label if named else type(handle).__name__
        admitted = _Control(
            name=str(name),
            viewer=viewer,
            may=may,
            takes=_takes(control, hold_hz),
            act=act,
            max_age_s=max_age_s,
            at_any_age=frozenset(at_any_age),
            on_late=on_late,
        )
        with self._lock:
            self._controls[control._impl.uuid] = admitted
        return handle

    def forget(self, handle: Any) -> None:
        """A control is no longer there."""
        with self._lock:
            self._controls.pop(handle._impl.uuid, None)

    def forget_viewer(self, viewer: int) -> None:
        """A viewer's page is gone."""
        with self._lock:
            self._controls = {key: one for key, one in self._controls.items() if one.viewer != viewer}

    def checked(self, viewer: int | None, data: bytes | str, age: MessageAge) -> bytes | None:
        """What viser may read of a message; None: nothing. age: the questions to the page that it comes from."""
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
            action = age.action(time.monotonic())
            if control.is_late(message, action):
                control.on_late(action.age_s)
                return self.drop(viewer, "too old", f"{control.name}: {in_words(action.age_s)}")
            if control.act is not None:
                control.act(viewer, action)
                return None
        elif isinstance(message, Shown):
            age.answer(message.request_uuid)
        return msgspec.msgpack.encode(message)

    def drop(self, viewer: int | None, kind: str, what: str) -> None:
        """Count a message that is not passed on, and report the first of its kind."""
        with self._lock:
            self.dropped[kind] += 1
            first = self.dropped[kind] == 1
        if first:
            who = "a page" if viewer is None else f"viewer {viewer + 1}"
            self.report(f"dropped a message of {who}: {kind}: {printable(what)[:LONGEST_SHOWN]}; more are only counted")


def in_words(age_s: float) -> str:
    """Return the age of a message in words."""
    if math.isinf(age_s):
        return "its age is not known: the page has not answered yet"
    return f"it came {age_s:.1f} s late"


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
