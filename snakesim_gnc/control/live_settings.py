"""The settings of the controller: first those of the configuration, later as operators change them during the run.

A request is answered between two ticks. It is refused, and nothing changes, unless the controller accepts all values
and can be constructed with them. After a change the controller is constructed again: it takes over from the measured
state, as it does after an arming.
"""

from typing import Any

import msgspec

from snakesim_gnc.control.controller import Controller
from snakesim_gnc.control.guarded import GuardedController
from snakesim_hal.base.errors import ConfigError, ControllerError, WireError
from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.model.plugins import CONTROLLERS, find_plugin, plugin_settings
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.client import Client
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.session import Query
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE, Decoder
from snakesim_hal.wire.messages import Answer, Clock, ControlSettings, Description, SettingsRequest
from snakesim_hal.wire.quantities import MAX_SCHEMA, MAX_SETTINGS

MAX_WAITING_REQUESTS = 8  # a later request displaces the oldest, which gets no answer
MAX_REASON = 500  # characters of a refusal, as the wire allows
MAX_LOGGED = 2000  # characters of settings in the log
MAX_NAME = (
    64  # characters of a controller's name on the wire; the end of a path identifies it better than its beginning
)


class LiveSettings:
    """The settings in force. Constructs controllers with them."""

    def __init__(self, client: Client, config: RunConfig) -> None:
        """Find the controller and check its settings. Raises ConfigError."""
        self._client = client
        self._config = config

        # The controller.
        self.plugin: type[Controller] = find_plugin(CONTROLLERS, config.controller)
        self._name = config.controller[-MAX_NAME:]
        self._robot: Description | None = None  # None: `configure` has not been called yet

        # The settings in force.
        self._settings = self._check_settings(config.control_settings, f"scenario {config.name!r}")
        self._changed_by: str | None = None  # None: they are those of the configuration
        self._change_count = 0
        self._published_change = -1  # number of the change that was published last

        # Requests and publications.
        self._waiting: Mailbox[Query] = Mailbox((MAX_WAITING_REQUESTS,))
        self._decoder = Decoder(SettingsRequest)
        client.session.on_query(keys.SETTINGS, self._waiting.put)
        self._publisher = client.session.latched_publisher(keys.SETTINGS_IN_FORCE, ControlSettings)

    @property
    def asks_for_senses(self) -> bool:
        """Whether views of this controller have `senses`."""
        return getattr(self.plugin, "SENSES", False)

    def configure(self, robot: Description) -> None:
        """Use this robot from now on. The settings are published again, because its time may have started over."""
        self._robot = robot
        self._published_change = -1

    def construct_controller(self) -> GuardedController:
        """Construct a controller with the settings in force. Raises ControllerError."""
        return self._construct(self._settings)

    def answer_requests(self, clock: Clock) -> bool:
        """Answer all waiting requests, and publish the settings if they are new.

        Returns:
            Whether the settings have changed, so that the controller must be constructed again.
        """
        count_before = self._change_count
        while not self._waiting.empty():
            question = self._waiting.get_nowait()
            answer = self._answer_request(question)
            question.reply(answer)
        if self._published_change != self._change_count:
            self._published_change = self._change_count
            self._publish(clock)
        return self._change_count != count_before

    def _answer_request(self, question: Query) -> Answer:
        """Put the settings of a request in force if the controller accepts them."""
        try:
            request = self._decoder.decode(question.payload, question.encoding)
        except WireError as error:
            return Answer(ok=False, reason=str(error)[:MAX_REASON], refusal=error.reason)
        if request.controller != self._name:
            reason = f"the controller is {self._name}, not {request.controller}"
            return Answer(ok=False, reason=reason, refusal="wrong_controller")
        try:
            section = msgspec.json.decode(request.settings, type=dict[str, Any])
            settings = self._check_settings(section, f"request of {request.who!r}")
            self._construct(settings)  # a trial: a constructor may refuse more than the schema does
        except (ConfigError, ControllerError, *UNDECODABLE) as error:
            return Answer(ok=False, reason=str(error)[:MAX_REASON], refusal="bad_settings")
        self._settings = settings
        self._changed_by = request.who
        self._change_count += 1
        print_stderr(f"settings changed by {request.who!r}: {_to_json(settings)[:MAX_LOGGED]}")
        return Answer(ok=True, reason=f"{self._name} has the settings of {request.who}")

    def _check_settings(self, section: dict[str, Any], source: str) -> Any:
        """Return the controller's settings from a section of TOML or JSON; `source` is named in a ConfigError."""
        return plugin_settings(self.plugin, section, source, self._config.control_section)

    def _construct(self, settings: Any) -> GuardedController:
        if self._robot is None:
            raise ControllerError("control has not met the robot yet")
        return GuardedController(self._config.controller, self.plugin, self._robot, settings)

    def _publish(self, clock: Clock) -> None:
        """Publish the settings in force, unless they or their schema are too long for a message.

        Clients cannot change what is not published.
        """
        settings = _to_json(self._settings)
        schema = _make_schema(type(self._settings))
        if len(settings) > MAX_SETTINGS or len(schema) > MAX_SCHEMA:
            return
        self._publisher.put(
            ControlSettings(
                tick=clock.tick,
                timestamp_ns=clock.timestamp_ns,
                controller=self._name,
                settings=settings,
                schema=schema,
                who=self._changed_by,
                changes=self._change_count,
            )
        )


def _to_json(settings: Any) -> str:
    return msgspec.json.encode(settings).decode()


def _make_schema(settings_type: type[msgspec.Struct]) -> str:
    """Return the JSON Schema of settings. For a type that has none it is empty, which allows anything."""
    try:
        return msgspec.json.encode(msgspec.json.schema(settings_type)).decode()
    except (TypeError, ValueError):
        return "{}"
