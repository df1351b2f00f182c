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
from snakesim_hal.model.plugins import (
    SENSORS,
    decode_plugin_settings,
    load_plugin,
    load_plugin_unless_file,
    require_base_class,
)
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.robot_file.sensor_model import SensorModel
from snakesim_hal.model.robot_file.sensors import (
    AnyMounted,
    BodySensor,
    ContactSensor,
    ImuSensor,
    PoseSensor,
    PowerSensor,
)
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
from snakesim_sim_backend.sensors.scope import BodyScope, SensorReader, SensorScope

# Sensors that look around: the model's name in the robot file -> its classes, each with a message of its own.
SENSOR_MODELS: dict[str, tuple[type[SensorModel], ...]] = {
    "rays": (RayCamera, RayBeams),
    "rendered": (RenderedDepth,),
    "recorded": (RecordedDepth,),
}


def make_body_reader(sensor: BodySensor, scope: BodyScope) -> SensorReader:
    """Make the reader of a sensor that measures the body itself, such as contacts, IMUs or the pose.

    Args:
        sensor: Entry of the sensor in the robot file.
        scope: Model, state and random generator that the reader may use.
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
            return PowerReader(
                scope.data, scope.motors, scope.windings, scope.config.robot.joint_table
            )


def make_sensor_rng(key: str, seed: int) -> np.random.Generator:
    """Return the random generator of one mounted sensor. Its numbers depend only on the sensor's key and the seed."""
    return np.random.default_rng((seed, crc32(key.encode())))


def check_sensor_models(robot: RobotFile) -> None:
    """Check that all sensors that are mounted on links can be made, without running the file of a plugin.

    Raises:
        ConfigError: A model is unknown, makes another message, or has wrong settings.
    """
    for key, sensor in robot.sensors.iterate_mounted():
        _find_model(key, sensor, load_plugin_unless_file)


def make_mounted_reader(key: str, sensor: AnyMounted, scope: SensorScope) -> SensorReader:
    """Make the reader of a sensor that is mounted on a link.

    Raises:
        ConfigError: The sensor's model is unknown, makes another message, or has wrong settings.
    """
    found = _find_model(key, sensor, load_plugin)
    assert found is not None
    model, settings = found
    return model(sensor, scope, settings)


def _find_model(
    key: str, sensor: AnyMounted, find: Callable[[str, str], Any]
) -> tuple[type[SensorModel], msgspec.Struct] | None:
    """Return the class that simulates a mounted sensor, and its checked settings.

    Args:
        key: Key on which the sensor publishes.
        sensor: Entry of the sensor in the robot file, with the name of the model.
        find: Function that loads a plugin by group and name. It may return None instead of loading a file.

    Returns:
        The class and its settings, or None if `find` returns None.

    Raises:
        ConfigError: The model has the wrong base class, makes another message, or does not accept the settings.
    """
    message = keys.find_message(key)
    if message is ColorImage:
        return RenderedColor, RenderedColor.Settings()
    assert message is not None
    model_class = _find_bundled_model(message, sensor.model)
    if model_class is None:
        model_class = find(SENSORS, sensor.model)
        if model_class is None:
            return None
        require_base_class(
            model_class, SensorModel, f"sensor {sensor.name!r}: model {sensor.model!r}"
        )
    # A sensor with a custom message has a schema, which is checked instead.
    if message is not CustomSample and model_class.message is not message:
        raise ConfigError(
            f"sensor {sensor.name!r}: model {sensor.model!r} does not make a {message.__name__}, which {key} carries; "
            f"set `message` of its class to what it makes",
            code="plugin/not-loadable",
        )
    settings = decode_plugin_settings(
        model_class, sensor.settings, f"sensor {sensor.name!r} of the robot file", "settings"
    )
    return model_class, settings


def _find_bundled_model(message: type[Message], name: str) -> type[SensorModel] | None:
    """Return the class of this package that makes a message by the model of this name; None without one."""
    for model in SENSOR_MODELS.get(name, ()):
        if model.message is message:
            return model
    return None
