"""Finds the reader of each sensor. A new type of sensor is a file with a reader, and a line here or an entry point.

Sensors that look around may have several models, of which the robot file chooses one: `model = "rays"`, the name of an
entry point in the group `snakesim.sensors`, or `./sonar.py:Sonar`. See docs/how-to/custom-sensors.md.
"""

from collections.abc import Callable
from typing import Any
from zlib import crc32

import msgspec
import numpy as np

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.plugins import SENSORS, find_installed, find_plugin, plugin_settings, require_base_class
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.sensor_model import SensorModel
from snakesim_hal.model.sensors import AnyMounted, BodySensor, ContactSensor, ImuSensor, PoseSensor, PowerSensor
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ColorImage, CustomSample, Message
from snakesim_sim_backend.sensors.contacts import ContactReader
from snakesim_sim_backend.sensors.depth import RayCamera
from snakesim_sim_backend.sensors.imu import ImuReader
from snakesim_sim_backend.sensors.pose import PoseReader
from snakesim_sim_backend.sensors.power import PowerReader
from snakesim_sim_backend.sensors.ranges import RayBeams
from snakesim_sim_backend.sensors.recorded import RecordedDepth
from snakesim_sim_backend.sensors.rendered import RenderedColor, RenderedDepth
from snakesim_sim_backend.sensors.scope import BodyScope, Reader, Scope

# Sensors that look around: the model's name in the robot file -> its classes, each with a message of its own.
MODELS: dict[str, tuple[type[SensorModel], ...]] = {
    "rays": (RayCamera, RayBeams),
    "rendered": (RenderedDepth,),
    "recorded": (RecordedDepth,),
}


def make_body_reader(sensor: BodySensor, scope: BodyScope) -> Reader:
    """Make the reader of a sensor that measures the body itself, such as contacts, IMUs or the pose.

    Args:
        sensor: The entry of the robot file.
        scope: Model, state and noise generator that the reader may use.
    """
    draw_normal = scope.noise.standard_normal
    match sensor:
        case ContactSensor():
            return ContactReader(scope.sim, scope.data, sensor, draw_normal, scope.physics)
        case ImuSensor():
            link_count = scope.config.robot.chain.modules + 1
            return ImuReader(scope.data, sensor, link_count, draw_normal)
        case PoseSensor():
            return PoseReader(scope.data, sensor, draw_normal)
        case PowerSensor():
            return PowerReader(scope.data, scope.motors, scope.windings, scope.config.robot.joint_table)


def own_noise(key: str, seed: int) -> np.random.Generator:
    """Return the noise generator of one sensor that looks around. Its numbers depend on its key and the seed alone."""
    return np.random.default_rng((seed, crc32(key.encode())))


def check_models(robot: RobotFile) -> None:
    """Check that all sensors that are mounted on links can be made, without running the file of a plugin.

    Raises:
        ConfigError: a model is unknown, makes another message, or has wrong settings.
    """
    for key, sensor in robot.sensors.mounted():
        _find_model(key, sensor, find_installed)


def mounted_reader(key: str, sensor: AnyMounted, scope: Scope) -> Reader:
    """Make the reader of a sensor that is mounted on a link.

    Raises:
        ConfigError: its model is unknown, makes another message, or has wrong settings.
    """
    found = _find_model(key, sensor, find_plugin)
    assert found is not None
    model, settings = found
    return model(sensor, scope, settings)


def _find_model(
    key: str, sensor: AnyMounted, find: Callable[[str, str], Any]
) -> tuple[type[SensorModel], msgspec.Struct] | None:
    """Return the class that simulates a mounted sensor, and its checked settings.

    Args:
        key: The key on which the sensor publishes.
        sensor: The entry of the robot file, with the name of the model.
        find: Loads a plug-in by group and name; it may return None if the plug-in is not needed here.

    Returns:
        The class and its settings; None if `find` does not load the model.

    Raises:
        ConfigError: The model has the wrong base class, makes another message, or does not accept the settings.
    """
    message = keys.find_message(key)
    if message is ColorImage:
        return RenderedColor, RenderedColor.Settings()
    assert message is not None
    model = _find_shipped_model(message, sensor.model)
    if model is None:
        model = find(SENSORS, sensor.model)
        if model is None:
            return None
        require_base_class(model, SensorModel, f"sensor {sensor.name!r}: model {sensor.model!r}")
    # A sensor with a custom message has a schema, which is checked instead.
    if message is not CustomSample and model.message is not message:
        raise ConfigError(
            f"sensor {sensor.name!r}: model {sensor.model!r} does not make a {message.__name__}, which {key} carries; "
            f"set `message` of its class to what it makes",
            code="plugin/not-loadable",
        )
    return model, plugin_settings(model, sensor.settings, f"sensor {sensor.name!r} of the robot file", "settings")


def _find_shipped_model(message: type[Message], name: str) -> type[SensorModel] | None:
    """Return the class of this package that makes a message by the model of this name; None without one."""
    for model in MODELS.get(name, ()):
        if model.message is message:
            return model
    return None
