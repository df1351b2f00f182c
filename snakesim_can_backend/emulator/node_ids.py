"""The node id of every emulated module: its joint's number, but for what the settings say is otherwise."""

from snakesim_can_backend.settings import CanSettings
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.robot import RobotFile


def node_ids(robot: RobotFile, settings: CanSettings) -> list[int]:
    """Tail to head. Raises ConfigError unless each number is there once."""
    names = [joint.name for joint in robot.joint_table]
    found = list(range(1, len(names) + 1))
    for name, truth in settings.mounted.items():
        if truth.id is not None and name in names:
            found[names.index(name)] = truth.id
    if sorted(found) != list(range(1, len(names) + 1)):
        raise ConfigError(
            f"`backends.can.mounted`: the modules would have the ids {found}; give each from 1 to {len(names)} once"
        )
    return found
