"""The thin shell around a pure core: connect, wait for ticks, publish the core's output, report it done."""

from collections.abc import Sequence
from typing import Protocol

from snakesim_hal.errors import SnakesimError
from snakesim_hal.faults.injector import Injector
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.scenario import Service as Schedule
from snakesim_hal.network.client import Client
from snakesim_hal.network.session import open_session
from snakesim_hal.process import SERVICE_PRIORITY, calm_down_after, hurry, settle_for_timing
from snakesim_hal.serve import START_LIMIT_S, arguments, process_options
from snakesim_hal.terminal import complain_of
from snakesim_hal.wire.messages import Clock, Description, Message

SILENCE_S = 1.0


class Service(Protocol):
    """The interface of a service process. The constructor subscribes to everything that it will read."""

    name: str
    urgent: bool = False  # whether the robot waits for this service in every tick

    def __init__(self, client: Client, config: RunConfig) -> None: ...

    def meet(self, robot: Description) -> None:
        """Take the robot's description; called before the first tick, and again when the HAL has restarted."""
        ...

    def outputs(self, clock: Clock) -> list[tuple[str, Message]] | None:
        """Output for a tick, as (key, message); None when the service has none yet."""
        ...

    def silence(self) -> list[tuple[str, Message]]:
        """Output when the HAL's clock has been silent for a second."""
        return []


def serve(service_type: type[Service], argv: Sequence[str] | None = None) -> int:
    """Run a service process until a stop signal; exit code 1 when it failed."""
    name = service_type.name
    given = process_options(arguments(f"Run the {name} service of a robot."), argv)
    try:
        if service_type.urgent and given.config.pace == "realtime":
            hurry(SERVICE_PRIORITY)
            calm_down_after(given.config.lease_ns * 1e-9)
        with open_session(given.link, connect_timeout_s=START_LIMIT_S) as session:
            schedule = given.config.services.get(name, Schedule())
            client = Client(session, name, every_ticks=schedule.every_ticks, pace=given.config.pace)
            service = service_type(client, given.config)
            robot = client.description(timeout_s=START_LIMIT_S)
            service.meet(robot)
            injector = Injector(name, given.config, session, newest=lambda: client.heard)
            injector.allow(emulated=robot.emulated, faults_allowed=given.config.faults_allowed)
            be_there(client, injector)
            settle_for_timing()
            try:
                loop(client, service, injector)
            finally:
                injector.close()
    except SnakesimError as error:
        complain_of(error, f"snakesim {name}")
        return 1
    except KeyboardInterrupt:
        return 0
    return 0


def be_there(client: Client, injector: Injector) -> None:
    """Declare the service present; from now on the robot may be armed, perhaps before the service's first tick."""
    clock = client.hear(SILENCE_S)
    if clock is not None:
        injector.turn(clock.stamp_ns, clock.arming, clock.lifecycle)
    client.announce()


def loop(client: Client, service: Service, injector: Injector) -> None:
    """Act on every due tick. A tick that is repeated, because time stands still, is answered again."""
    for clock in client.ticks(SILENCE_S):
        if clock is None:
            injector.idle()
            for key, message in service.silence():
                client.put(key, message)
            continue
        injector.turn(clock.stamp_ns, clock.arming, clock.lifecycle)
        robot = client.met_anew()
        if robot is not None:
            service.meet(robot)
        outputs = service.outputs(clock)
        if outputs is None:
            continue
        for key, message in outputs:
            client.put(key, message)
        client.done(clock.tick)
