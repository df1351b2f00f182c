"""Which reader makes which message. A new type of sensor is a file with a reader, and a line here or an entry point.

Sensors that look around may have several models, of which the robot file chooses one: `model = "rays"`, the name of an
entry point in the group `snakesim.sensors`, or `./sonar.py:Sonar`. See docs/sensors.md.
"""

from collections.abc import Callable
from typing import Any
from zlib import crc32

import numpy as np

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.plugins import SENSORS, find_installed, find_plugin, plugin_settings
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.sensors import AnyMounted
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ColorImage, Contacts, Imu, Message, OwnSample, Pose, Power
from snakesim_sim_backend.sensors.contacts import ContactReader
from snakesim_sim_backend.sensors.depth import RayCamera
from snakesim_sim_backend.sensors.imu import ImuReader
from snakesim_sim_backend.sensors.pose import PoseReader
from snakesim_sim_backend.sensors.power import PowerReader
from snakesim_sim_backend.sensors.ranges import RayBeams
from snakesim_sim_backend.sensors.recorded import RecordedDepth
from snakesim_sim_backend.sensors.rendered import RenderedColor, RenderedDepth
from snakesim_sim_backend.sensors.scope import BodyScope, Reader, Scope

SYNCHRONOUS: dict[type[Message], Callable[[Any, BodyScope], Reader]] = {
    Contacts: lambda sensor, at: ContactReader(at.sim, at.data, sensor, at.noise.standard_normal, at.physics),
    Imu: lambda sensor, at: ImuReader(at.data, sensor, at.config.robot.chain.modules + 1, at.noise.standard_normal),
    Pose: lambda sensor, at: PoseReader(at.data, sensor, at.noise.standard_normal),
    Power: lambda _, at: PowerReader(at.data, at.motors, at.windings, at.config.robot.joint_table),
}
MODELS = {"rays": (RayCamera, RayBeams), "rendered": (RenderedDepth,), "recorded": (RecordedDepth,)}
THREADED: dict[tuple[type[Message], str], Any] = {
    (model.message, name): model for name, models in MODELS.items() for model in models
}


def own_noise(key: str, seed: int) -> np.random.Generator:
    """The noise of one sensor that looks around."""
    return np.random.default_rng((seed, crc32(key.encode())))


def check_models(robot: RobotFile) -> None:
    """Whether all sensors at places on links can be made. Runs no file of a plugin. Raises ConfigError."""
    for key, sensor in robot.sensors.mounted():
        _model(key, sensor, find_installed)


def mounted_reader(key: str, sensor: AnyMounted, scope: Scope) -> Reader:
    """The reader of a sensor at a place on a link. Raises ConfigError."""
    model, settings = _model(key, sensor, find_plugin)
    return model(sensor, scope, settings)


def _model(key: str, sensor: AnyMounted, find: Callable[[str, str], Any]) -> tuple[Any, Any]:
    """Its class, and its settings, which are checked; None where `find` finds none."""
    message = keys.message_at(key)
    if message is ColorImage:
        return RenderedColor, RenderedColor.Settings()
    assert message is not None
    model = THREADED.get((message, sensor.model)) or find(SENSORS, sensor.model)
    if model is None:
        return None, None
    # Of a sensor with a message of its own the schema is checked.
    if message is not OwnSample and getattr(model, "message", None) is not message:
        raise ConfigError(
            f"sensor {sensor.name!r}: model {sensor.model!r} does not make a {message.__name__}, which is what {key} "
            f"carries; its class says in `message` what it makes"
        )
    return model, plugin_settings(model, sensor.settings, f"sensor {sensor.name!r} of the robot file", "settings")
