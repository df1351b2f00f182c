"""The controller's settings: from the configuration, and then as operators change them while it runs.

A request is answered between two ticks. It is refused, and nothing changes, unless the controller accepts all values
and can be made with them. Then the controller is made again: it takes over from the measured state, as after an arming.
"""

from typing import Any

import msgspec

from snakesim_gnc.control.controller import Controller
from snakesim_gnc.control.guarded import Guarded
from snakesim_hal.base.errors import ConfigError, ControllerError, WireError
from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.model.plugins import CONTROLLERS, find_plugin, plugin_settings
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.client import Client
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.session import Question
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE, Decoder
from snakesim_hal.wire.messages import Answer, Clock, ControlSettings, Description, SettingsRequest
from snakesim_hal.wire.quantities import MAX_SCHEMA, MAX_SETTINGS

MAX_WAITING = 8  # later requests displace the oldest, which gets no answer


class LiveSettings:
    """The settings in force. Makes controllers with them."""

    def __init__(self, client: Client, config: RunConfig) -> None:
        """Finds the controller and checks its settings. Raises ConfigError."""
        self._client, self._config = client, config
        self.plugin: type[Controller] = find_plugin(CONTROLLERS, config.controller)
        self._name = config.controller[-64:]
        self._settings = self._checked(config.control_settings, f"scenario {config.name!r}")
        self._waiting: Mailbox[Question] = Mailbox((MAX_WAITING,))
        self._decoder = Decoder(SettingsRequest)
        self._robot: Description | None = None
        self._by: str | None = None
        self._changes = 0
        self._published = -1  # number of the change that was published last
        client.session.on_question(keys.SETTINGS, self._waiting.put)
        self._publisher = client.session.latched_publisher(keys.SETTINGS_IN_FORCE, ControlSettings)

    @property
    def asks_for_senses(self) -> bool:
        """Whether views of this controller have `senses`."""
        return getattr(self.plugin, "SENSES", False)

    def configure(self, robot: Description) -> None:
        """For this robot from now on, whose time may have started over."""
        self._robot, self._published = robot, -1

    def controller(self) -> Guarded:
        """A new controller with the settings in force. Raises ControllerError."""
        return self._made(self._settings)

    def turn(self, clock: Clock) -> bool:
        """Answer all requests that wait, and publish what is new; whether a controller must be made again."""
        before = self._changes
        while not self._waiting.empty():
            question = self._waiting.get_nowait()
            question.reply(self._answer(question))
        if self._published != self._changes:
            self._published = self._changes
            self._publish(clock)
        return self._changes != before

    def _answer(self, question: Question) -> Answer:
        try:
            request = self._decoder.decode(question.payload, question.encoding)
        except WireError as error:
            return Answer(ok=False, reason=str(error)[:500], refusal=error.reason)
        if request.controller != self._name:
            return Answer(
                ok=False, reason=f"the controller is {self._name}, not {request.controller}", refusal="wrong_controller"
            )
        try:
            asked = msgspec.json.decode(request.settings, type=dict[str, Any])
            settings = self._checked(asked, f"request of {request.who!r}")
            self._made(settings)
        except (ConfigError, ControllerError, *UNDECODABLE) as error:
            return Answer(ok=False, reason=str(error)[:500], refusal="bad_settings")
        self._settings, self._by, self._changes = settings, request.who, self._changes + 1
        print_stderr(f"settings changed by {request.who!r}: {_in_json(settings)[:2000]}")
        return Answer(ok=True, reason=f"{self._name} has the settings of {request.who}")

    def _checked(self, section: dict[str, Any], source: str) -> Any:
        return plugin_settings(self.plugin, section, source, self._config.control_section)

    def _made(self, settings: Any) -> Guarded:
        if self._robot is None:
            raise ControllerError("control has not met the robot yet")
        return Guarded(self._config.controller, self.plugin, self._robot, settings)

    def _publish(self, clock: Clock) -> None:
        settings, schema = _in_json(self._settings), _schema(type(self._settings))
        if len(settings) > MAX_SETTINGS or len(schema) > MAX_SCHEMA:
            return  # this controller's settings cannot be changed while it runs
        self._publisher.put(
            ControlSettings(
                tick=clock.tick,
                timestamp_ns=clock.timestamp_ns,
                controller=self._name,
                settings=settings,
                schema=schema,
                who=self._by,
                changes=self._changes,
            )
        )


def _in_json(settings: Any) -> str:
    return msgspec.json.encode(settings).decode()


def _schema(settings: type[msgspec.Struct]) -> str:
    """The JSON Schema; of a type that has none an empty one, which allows anything."""
    try:
        return msgspec.json.encode(msgspec.json.schema(settings)).decode()
    except (TypeError, ValueError):
        return "{}"
