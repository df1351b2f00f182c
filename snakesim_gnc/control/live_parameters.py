"""The parameters of the controller: first those of the configuration, later as operators change them during the run.

A request is answered between two ticks. It is refused, and nothing changes, unless the controller accepts all values
and can be constructed with them. After a change the controller is constructed again: it takes over from the measured
state, as it does after an arming.
"""

from typing import Any

import msgspec

from snakesim_gnc.control.guarded import GuardedController
from snakesim_hal.base.errors import ConfigError, ControllerError, WireError
from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.controller import Controller, decode_parameters, load_controller
from snakesim_hal.model.json_schema import make_schema
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.client import Client
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.streams import Query
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE, Decoder
from snakesim_hal.wire.messages import Answer, Clock, ControlParameters, Description, ParametersRequest
from snakesim_hal.wire.quantities import MAX_PARAMETERS_JSON, MAX_SCHEMA

MAX_WAITING_REQUESTS = 8  # a later request displaces the oldest, which gets no answer
MAX_REASON = 500  # characters of a refusal, as the wire allows
MAX_LOGGED = 2000  # characters of parameters in the log
MAX_NAME = 64  # characters of a controller's name on the wire; of a path these are the last


class LiveParameters:
    """The parameters in force. Constructs controllers with them."""

    def __init__(self, client: Client, config: RunConfig) -> None:
        """Load the controller class of a run, and check its parameters, which clients may change while it runs.

        Args:
            client: connection to the robot, on which requests arrive and parameters are published.
            config: configuration of the run, with the controller's name and parameters.

        Raises:
            ConfigError: there is no such controller, or its parameters are invalid.
        """
        self._client = client
        self._config = config

        # The controller.
        self.controller_class: type[Controller[Any]] = load_controller(config.controller)
        self._name = config.controller[-MAX_NAME:]
        self._robot: Description | None = None  # None: `configure` has not been called yet

        # The parameters in force.
        self._parameters = self._check_parameters(config.controller_parameters, f"scenario {config.name!r}")
        self._schema = _make_schema(type(self._parameters))  # reads a source file, so not in a control cycle
        self._changed_by: str | None = None  # None: they are those of the configuration
        self._change_count = 0
        self._published_change = -1  # number of the change that was published last

        # Requests and publications.
        self._waiting: Mailbox[Query] = Mailbox((MAX_WAITING_REQUESTS,))
        self._decoder = Decoder(ParametersRequest)
        client.session.on_query(keys.PARAMETERS, self._waiting.put)
        self._publisher = client.session.latched_publisher(keys.PARAMETERS_IN_FORCE, ControlParameters)

    @property
    def uses_sensors(self) -> bool:
        """Whether observations of this controller have `sensor_samples`."""
        return self.controller_class.uses_sensors

    def configure(self, robot: Description) -> None:
        """Use this robot from now on. The parameters are published again, because its time may have started over."""
        self._robot = robot
        self._published_change = -1

    def construct_controller(self) -> GuardedController:
        """Construct a controller with the parameters in force. Raises ControllerError."""
        return self._construct(self._parameters)

    def answer_requests(self, clock: Clock) -> bool:
        """Answer all waiting requests, and publish the parameters if they are new.

        Returns:
            Whether the parameters have changed, so that the controller must be constructed again.
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
        """Put the parameters of a request in force if the controller accepts them.

        Args:
            question: the encoded request.

        Returns:
            The answer; a refusal has its reason as text and as a code.
        """
        try:
            request = self._decoder.decode(question.payload, question.encoding)
        except WireError as error:
            return Answer(ok=False, reason=str(error)[:MAX_REASON], refusal=error.reason)
        if request.controller != self._name:
            reason = f"the controller is {self._name}, not {request.controller}"
            return Answer(ok=False, reason=reason, refusal="wrong_controller")
        try:
            section = msgspec.json.decode(request.parameters, type=dict[str, Any])
            parameters = self._check_parameters(section, f"request of {request.requester!r}")
            self._construct(parameters)  # a trial: a constructor may refuse more than the schema does
        except (ConfigError, ControllerError, *UNDECODABLE) as error:
            return Answer(ok=False, reason=str(error)[:MAX_REASON], refusal="bad_parameters")
        self._parameters = parameters
        self._changed_by = request.requester
        self._change_count += 1
        print_stderr(f"parameters changed by {request.requester!r}: {_to_json(parameters)[:MAX_LOGGED]}")
        return Answer(ok=True, reason=f"{self._name} has the parameters of {request.requester}")

    def _check_parameters(self, section: dict[str, Any], source: str) -> Any:
        """Return the controller's parameters from a section of TOML or JSON; `source` is named in a ConfigError."""
        return decode_parameters(self.controller_class, section, source, self._config.control_section)

    def _construct(self, parameters: Any) -> GuardedController:
        if self._robot is None:
            raise ControllerError("control has not met the robot yet")
        return GuardedController(self._config.controller, self.controller_class, self._robot, parameters)

    def _publish(self, clock: Clock) -> None:
        """Publish the parameters in force, unless they or their schema are too long for a message.

        Clients cannot change parameters that are not published.

        Args:
            clock: the current tick, which the message names.
        """
        parameters = _to_json(self._parameters)
        if len(parameters) > MAX_PARAMETERS_JSON or len(self._schema) > MAX_SCHEMA:
            return
        self._publisher.put(
            ControlParameters(
                tick=clock.tick,
                timestamp_ns=clock.timestamp_ns,
                controller=self._name,
                parameters=parameters,
                schema=self._schema,
                requester=self._changed_by,
                changes=self._change_count,
            )
        )


def _to_json(parameters: Any) -> str:
    return msgspec.json.encode(parameters).decode()


def _make_schema(parameters_type: type[msgspec.Struct]) -> str:
    """Return the JSON Schema of parameters. For a type that has none it is empty, which allows anything."""
    try:
        return msgspec.json.encode(make_schema(parameters_type)).decode()
    except (TypeError, ValueError):
        return "{}"
