"""The guidance process: reads the sensors, and publishes `guidance/world`."""

from snakesim_gnc.guidance.world_source import WorldSource
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.network.client import HostClient
from snakesim_hal.service import Service
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, Message, RobotDescription


class GuidanceService(Service):
    """Makes world models from sensor samples.

    With `map = "known"` the obstacles of the scene are known as from a survey. Otherwise guidance does not use them.
    """

    name = "guidance"

    def __init__(self, client: HostClient, config: RunConfig) -> None:
        """Subscribe to the sensors of the robot."""
        self._source: WorldSource
        # Imported here, because each source imports half of this package: a run uses one of them, and its supervisor,
        # which only checks this class, uses none.
        if config.mission.map == "perceived":
            from snakesim_gnc.guidance.perceived_source import PerceivedSource

            self._source = PerceivedSource(client, config)
        else:
            from snakesim_gnc.guidance.surveyed_source import SurveyedSource

            self._source = SurveyedSource(client, config)

    def configure(self, robot: RobotDescription) -> None:
        """Create the model for this robot."""
        self._source.configure(robot)

    def outputs(self, clock: Clock) -> list[tuple[str, Message]] | None:
        """Return the world model at this tick; None while it is unknown."""
        world = self._source.make_world(clock)
        if world is None:
            return None
        return [(keys.WORLD, world)]
