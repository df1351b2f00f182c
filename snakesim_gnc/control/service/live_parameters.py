"""The parameters of the controller: first those of the configuration, later as operators change them during the run.

A request is answered between two ticks. It is refused, and nothing changes, unless the controller accepts all values
and can be constructed with them. After a change the controller is constructed again: it takes over from the measured
state, as it does after an arming.
"""

from typing import Any

import msgspec

from snakesim_gnc.control.service.guarded import GuardedController
from snakesim_hal.base.errors import ConfigError, ControllerError, WireError
from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.controller import Controller, decode_parameters, load_controller
from snakesim_hal.model.fields.json_schema import make_schema
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.client import HostClient
from snakesim_hal.network.mailbox import Mailbox
from snakesim_hal.network.streams import IncomingQuery
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE, MessageDecoder
from snakesim_hal.wire.messages import (
    Answer,
    Clock,
    ControlParameters,
    ParametersRequest,
    RobotDescription,
)
from snakesim_hal.wire.quantities import MAX_PARAMETERS_JSON, MAX_SCHEMA

MAX_WAITING_REQUESTS = 8  # a later request displaces the oldest, which gets no answer
MAX_REASON_LENGTH = 500  # characters of a refusal, as the wire allows
MAX_LOGGED_LENGTH = 2000  # characters of parameters in the log
MAX_NAME_LENGTH = 64  # characters of a controller's name on the wire; of a path these are the last


class LiveParameters:
    """The parameters in force. Constructs controllers with them."""

    def __init__(self, client: HostClient, config: RunConfig) -> None:
        """Load the controller class of a run, and check its parameters, which clients may change while it runs.

        Args:
            client: Connection to the robot, on which requests arrive and parameters are published.
            config: Configuration of the run, with the controller's name and parameters.

        Raises:
            ConfigError: There is no such controller, or its parameters are invalid.
        """
        self._client = client
        self._config = config

        # The controller.
        self.controller_class: type[Controller[Any]] = load_controller(config.controller)
        self._name = config.controller[-MAX_NAME_LENGTH:]
        self._robot: RobotDescription | None = None  # None if `configure` has not been called yet

        # The parameters in force.
        self._parameters = self._check_parameters(
            config.controller_parameters, f"scenario {config.name!r}"
        )
        # Reads a source file, so not in a control cycle.
        self._schema_json = _make_schema_json(type(self._parameters))
        self._last_requester: str | None = None  # None if they are those of the configuration
        self._change_count = 0
        self._published_change_count = -1  # number of the change that was published last

        # Requests and publications.
        self._request_queue: Mailbox[IncomingQuery] = Mailbox((MAX_WAITING_REQUESTS,))
        self._decoder = MessageDecoder(ParametersRequest)
        client.session.on_query(keys.PARAMETERS, self._request_queue.put)
        self._publisher = client.session.declare_latched_publisher(
            keys.PARAMETERS_IN_FORCE, ControlParameters
        )

    @property
    def uses_sensors(self) -> bool:
        """Whether observations of this controller have `sensor_samples`."""
        return self.controller_class.uses_sensors

    def configure(self, robot: RobotDescription) -> None:
        """Construct controllers for this robot from now on, and publish the parameters again in the next tick.

        They are published again because robot time may have started over.
        """
        self._robot = robot
        self._published_change_count = -1

    def construct_controller(self) -> GuardedController:
        """Construct a controller with the parameters in force. Raises ControllerError."""
        return self._construct_controller(self._parameters)

    def answer_requests(self, clock: Clock) -> bool:
        """Answer all queued requests to change parameters, and publish the parameters in force if they are new.

        Args:
            clock: The current tick, which the published message names.

        Returns:
            Whether the parameters have changed, so that the controller must be constructed again.
        """
        count_before = self._change_count
        while not self._request_queue.empty():
            query = self._request_queue.get_nowait()
            answer = self._answer_request(query)
            query.reply(answer)
        if self._published_change_count != self._change_count:
            self._published_change_count = self._change_count
            self._publish_parameters(clock)
        return self._change_count != count_before

    def _answer_request(self, query: IncomingQuery) -> Answer:
        """Put the parameters of a request in force if the controller accepts them.

        Args:
            query: The encoded request.

        Returns:
            The answer to the request. A refusal has its reason as a text and as a code.
        """
        try:
            request = self._decoder.decode(query.payload, query.encoding)
        except WireError as error:
            return Answer(ok=False, reason=str(error)[:MAX_REASON_LENGTH], refusal=error.reason)
        if request.controller != self._name:
            reason = f"the controller is {self._name}, not {request.controller}"
            return Answer(ok=False, reason=reason, refusal="wrong_controller")
        try:
            parameter_values = msgspec.json.decode(request.parameters, type=dict[str, Any])
            parameters = self._check_parameters(
                parameter_values, f"request of {request.requester!r}"
            )
            # A trial: a constructor may refuse more than the schema does.
            self._construct_controller(parameters)
        except (ConfigError, ControllerError, *UNDECODABLE) as error:
            return Answer(ok=False, reason=str(error)[:MAX_REASON_LENGTH], refusal="bad_parameters")
        self._parameters = parameters
        self._last_requester = request.requester
        self._change_count += 1
        print_stderr(
            f"parameters changed by {request.requester!r}: {_to_json(parameters)[:MAX_LOGGED_LENGTH]}"
        )
        return Answer(ok=True, reason=f"{self._name} has the parameters of {request.requester}")

    def _check_parameters(self, section: dict[str, Any], source: str) -> Any:
        """Return the controller's parameters from a section of TOML or JSON; `source` is named in a ConfigError."""
        return decode_parameters(
            self.controller_class, section, source, self._config.control_section
        )

    def _construct_controller(self, parameters: Any) -> GuardedController:
        if self._robot is None:
            raise ControllerError("control has not met the robot yet")
        return GuardedController(
            self._config.controller, self.controller_class, self._robot, parameters
        )

    def _publish_parameters(self, clock: Clock) -> None:
        """Publish the parameters in force, unless they or their schema are too long for a message.

        Clients cannot change parameters that are not published.

        Args:
            clock: The current tick, which the message names.
        """
        parameters_json = _to_json(self._parameters)
        if len(parameters_json) > MAX_PARAMETERS_JSON or len(self._schema_json) > MAX_SCHEMA:
            return
        self._publisher.put(
            ControlParameters(
                tick=clock.tick,
                timestamp_ns=clock.timestamp_ns,
                controller=self._name,
                parameters=parameters_json,
                schema=self._schema_json,
                requester=self._last_requester,
                changes=self._change_count,
            )
        )


def _to_json(parameters: Any) -> str:
    return msgspec.json.encode(parameters).decode()


def _make_schema_json(parameters_type: type[msgspec.Struct]) -> str:
    """Return the JSON Schema of parameters. For a type that has none it is empty, which allows anything."""
    try:
        return msgspec.json.encode(make_schema(parameters_type)).decode()
    except (TypeError, ValueError):
        return "{}"
