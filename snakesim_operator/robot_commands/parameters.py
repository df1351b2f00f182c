"""The settings of a running controller, one by one: `snakesim param`, and the same for programs and the console.

Control publishes what is in force with a JSON Schema: range, unit and description of each. That comes from the network:
it decides what is shown, and nothing else; control checks every value again.
"""

import json
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import msgspec

from snakesim_hal.base.errors import ConfigError, ControllerError, NotConnectedError, RefusedError, did_you_mean, short
from snakesim_hal.base.process import user_name
from snakesim_hal.base.terminal import say
from snakesim_hal.model.scenario import parse_set
from snakesim_hal.network.session import Reader, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ControlSettings, ControlState, SettingsRequest
from snakesim_operator.base.robot_selection import RobotSelection
from snakesim_operator.base.targets import CONNECT_S, only_robot
from snakesim_operator.robot_commands.command import ANSWER_S, SHOWN_S

PREFIX = "control."
MAX_PARAMETERS = 100
LONGEST_NAME, LONGEST_ABOUT = 40, 200
PUBLISHED_S = 3.0
GONE_S = 1.0  # without settings in force, after a controller that published them has been asked
GOES_ON_S = 0.3  # until the next report of a controller that goes on, in real time; time may stand
LOOK_S = 0.01


@dataclass(frozen=True)
class Parameter:
    """One setting, and what its schema says of it."""

    name: str
    value: Any
    unit: str = ""
    about: str = ""
    choices: tuple[str, ...] = ()
    least: float | None = None
    most: float | None = None
    above_least: bool = False  # `least` itself is too little

    @property
    def range(self) -> str:
        """What values it may have, in words."""
        if self.choices:
            return " or ".join(self.choices)
        if isinstance(self.value, str):
            return "a text"
        sign = ">" if self.above_least else ">="
        low = "" if self.least is None else f"{sign} {self.least:g}"
        high = "" if self.most is None else f"<= {self.most:g}"
        return ", ".join(filter(None, (low, high)))

    @property
    def shown(self) -> str:
        """Its value as TOML would have it, with its unit."""
        return f"{in_text(self.value)} {self.unit}".strip() if self.unit != "1" else in_text(self.value)


def in_text(value: Any) -> str:
    """A value as `param set` takes it."""
    return value if isinstance(value, str) else json.dumps(value)


def parameters_of(settings: ControlSettings) -> list[Parameter]:
    """The parameters in force, without those that a schema does not say enough of to be read."""
    try:
        schema, values = json.loads(settings.schema), msgspec.json.decode(settings.settings, type=dict[str, Any])
        properties = _resolved(schema, schema)["properties"]
        found = [(name, _resolved(schema, properties.get(name, {})), value) for name, value in values.items()]
        return [_parameter(name, of, value) for name, of, value in found[:MAX_PARAMETERS]]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, msgspec.DecodeError):
        return []


def _resolved(schema: dict[str, Any], part: dict[str, Any]) -> dict[str, Any]:
    reference = part.get("$ref")
    return part if reference is None else schema["$defs"][reference.rpartition("/")[2]]


def _parameter(name: str, of: dict[str, Any], value: Any) -> Parameter:
    choices = of.get("enum")
    return Parameter(
        name[:LONGEST_NAME],
        value,
        unit=str(of.get("unit", ""))[:LONGEST_NAME],
        about=str(of.get("description", ""))[:LONGEST_ABOUT],
        choices=tuple(str(choice) for choice in choices) if isinstance(choices, list) else (),
        least=_number(of, "minimum", "exclusiveMinimum"),
        most=_number(of, "maximum", "exclusiveMaximum"),
        above_least="exclusiveMinimum" in of,
    )


def _number(of: dict[str, Any], *names: str) -> float | None:
    found = (float(of[name]) for name in names if isinstance(of.get(name), int | float))
    return next((number for number in found if math.isfinite(number)), None)


def differing(before: ControlSettings, now: ControlSettings) -> list[tuple[Parameter, Parameter]]:
    """Those that have another value, before and now."""
    old = {one.name: one for one in parameters_of(before)}
    pairs = [(old[one.name], one) for one in parameters_of(now) if one.name in old]
    return [(was, one) for was, one in pairs if was.value != one.value]


def in_force(session: Session) -> ControlSettings:
    """The settings of the running controller. Raises NotConnectedError when none publishes any."""
    found = session.latest(keys.SETTINGS_IN_FORCE, ControlSettings, PUBLISHED_S)
    if found is None:
        raise NotConnectedError(
            f"no controller publishes its settings within {PUBLISHED_S:g} s: control does not run here, or is a client "
            "of another kind"
        )
    return found


def change(session: Session, changes: Mapping[str, Any], who: str) -> tuple[ControlSettings, ControlSettings]:
    """Have the controller go on with other values, all of them or none. Returns what was in force, and what is now.

    Args:
        session: A session on the robot's network.
        changes: Values by name, such as `control.speed_kp_s`.
        who: Who asks.

    Raises:
        ConfigError: There is no such parameter.
        RefusedError: Control refuses a value, with its reason; or does not show what it has accepted.
        ControllerError: The controller cannot go on with what it has accepted, so control has ended.
        NotConnectedError: No controller publishes its settings.
    """
    before = in_force(session)
    values = msgspec.json.decode(before.settings, type=dict[str, Any])
    wanted = {known_name(name, before): value for name, value in changes.items()}
    settings = msgspec.json.encode({**values, **wanted}).decode()
    request = SettingsRequest(who=who, controller=before.controller, settings=settings)
    states = session.reader(keys.CONTROL_STATE, ControlState)
    try:
        answer = session.ask(keys.SETTINGS, request, ANSWER_S)
        if not answer.ok:
            raise RefusedError(answer.reason)
        now = _shown(session, before)
        _check_it_goes_on(states, now, changes)
    finally:
        session.stop_reading(states)
    if now is None:
        raise RefusedError(f"NOT CONFIRMED: {answer.reason}; but no controller publishes them")
    return before, now


def _shown(session: Session, before: ControlSettings) -> ControlSettings | None:
    """Return the settings that are in force after others; None when none are published in time."""
    deadline = time.monotonic() + SHOWN_S
    while time.monotonic() < deadline:
        now = session.latest(keys.SETTINGS_IN_FORCE, ControlSettings, GONE_S)
        if now is None or now.changes > before.changes:
            return now
    return None


def _check_it_goes_on(states: Reader[ControlState], now: ControlSettings | None, changes: Mapping[str, Any]) -> None:
    """Raise ControllerError if the controller cannot go on with these changes.

    While the robot is armed, control reports its state 20 times a second. Otherwise nothing shows it before the arming.

    Args:
        states: Control's reports since the changes were asked for.
        now: The settings in force with them; None: control publishes none any more.
        changes: Values by name.
    """
    deadline = time.monotonic() + GOES_ON_S
    while time.monotonic() < deadline:
        reported = states.drain()
        for state in reported:
            if state.failed:
                given = ", ".join(f"{name}={in_text(value)}" for name, value in changes.items())
                raise ControllerError(
                    f"{given}: accepted, and then control has ended: {state.reason}. The robot stops. Start control "
                    "again with another value"
                )
        if now is not None and any(state.tick > now.tick for state in reported):
            return
        time.sleep(LOOK_S)


def known_name(name: str, settings: ControlSettings) -> str:
    """The field that `control.NAME` stands for. Raises ConfigError."""
    known = [PREFIX + parameter.name for parameter in parameters_of(settings)]
    if name not in known:
        raise ConfigError(
            f"controller {settings.controller} has no parameter {short(name)!r}; {did_you_mean(name, known)}it has "
            f"{', '.join(known) or 'none'}"
        )
    return name.removeprefix(PREFIX)


def list_parameters(where: RobotSelection) -> int:
    """`snakesim param list`."""
    with open_session(only_robot(where, "param list"), CONNECT_S) as session:
        settings = in_force(session)
    parameters = parameters_of(settings)
    by = (
        "from its configuration"
        if settings.who is None
        else f"set by {settings.who} at {settings.timestamp_ns * 1e-9:g} s"
    )
    say(f"controller {settings.controller}, {len(parameters)} parameters, {by}")
    rows = [(PREFIX + one.name, one.shown, one.range, one.about) for one in parameters]
    widths = [max((len(row[i]) for row in rows), default=0) for i in range(3)]
    for row in rows:
        say("  " + "  ".join([*(cell.ljust(width) for cell, width in zip(row, widths, strict=False)), row[3]]).rstrip())
    return 0


def get_parameter(name: str, where: RobotSelection) -> int:
    """`snakesim param get`: the value alone, for scripts."""
    with open_session(only_robot(where, "param get"), CONNECT_S) as session:
        settings = in_force(session)
    field = known_name(name, settings)
    say(next(in_text(one.value) for one in parameters_of(settings) if one.name == field))
    return 0


def set_parameters(texts: list[str], where: RobotSelection) -> int:
    """`snakesim param set`. Raises ConfigError, RefusedError, ControllerError."""
    changes = {override.key: override.value for override in map(parse_set, texts)}
    with open_session(only_robot(where, "param set"), CONNECT_S) as session:
        before, now = change(session, changes, user_name())
    changed = differing(before, now)
    for was, one in changed:
        say(f"{PREFIX}{one.name}: {in_text(was.value)} -> {one.shown}, by {now.who}, tick {now.tick}")
    if not changed:
        say(f"controller {now.controller} has these values already")
    return 0
