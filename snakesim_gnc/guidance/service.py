"""The guidance process: sensors in, `guidance/world` out."""

from snakesim_gnc.guidance.core import WorldModel
from snakesim_hal.model.scenario import RunConfig, place_all
from snakesim_hal.network.client import Client
from snakesim_hal.service import Service
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, Contacts, Description, JointState, Message, Pose


class Guidance(Service):
    """Sensors to world model."""

    name = "guidance"

    def __init__(self, client: Client, config: RunConfig) -> None:
        """The obstacles of the scene file are known beforehand, as from a survey."""
        self._known = [placed.obstacle for placed in place_all(config) if not placed.walkable]
        self._joints = client.subscribe(keys.JOINTS, JointState)
        self._contacts = client.subscribe(keys.CONTACTS, Contacts)
        self._pose = client.subscribe(keys.POSE, Pose)
        self._client = client
        self._model: WorldModel | None = None

    def meet(self, robot: Description) -> None:
        """Create the model for this robot."""
        self._model = WorldModel(robot, self._known)

    def outputs(self, clock: Clock) -> list[tuple[str, Message]] | None:
        """The world at this tick; None while the joints or the pose are unknown."""
        joints, pose = self._client.read(self._joints), self._client.read(self._pose)
        if self._model is None or joints is None or pose is None:
            return None
        contacts = self._client.read(self._contacts)
        return [(keys.WORLD, self._model.update(clock.tick, clock.stamp_ns, joints, contacts, pose))]
