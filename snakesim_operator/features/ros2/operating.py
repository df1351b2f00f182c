"""Arm, disarm, clear and stop as services of ROS: the same requests as those of `snakesim arm` and the others."""

import time
from collections.abc import Callable
from typing import Any

from snakesim_hal.base.errors import NotConnectedError, RefusedError
from snakesim_hal.base.process import user_name
from snakesim_hal.network.session import Link, Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Description, LifecycleRequest, Status, request_to_arm
from snakesim_operator.base.robot_selection import RobotSelection
from snakesim_operator.features.ros2.graph import Node
from snakesim_operator.features.ros2.message_age import why_request_too_old
from snakesim_operator.features.ros2.server import Server, told
from snakesim_operator.features.ros2.service_types import TRIGGER
from snakesim_operator.robot_commands.command import ask_host
from snakesim_operator.robot_commands.stop import estop

DESCRIBED_S, READY_S = 3.0, 5.0  # a controller may be on its way
WHO = f"{user_name()[:40]}, ros2"


def operating_servers(session: Session, node: Node, link: Link, prefix: str, *, operate: bool) -> list[Server]:
    """The services. prefix: of their names; operate: whether ROS may do more than stop."""
    acts: dict[str, Callable[[], str]] = {"stop": lambda: _stop(link)}
    if operate:
        acts |= {
            "arm": lambda: _arm(session, link),
            "disarm": lambda: _ask(session, link, LifecycleRequest(action="disarm", who=WHO), "disarmed"),
            "clear": lambda: _ask(session, link, LifecycleRequest(action="clear", who=WHO), "cleared"),
        }
    return [
        Server(
            node,
            f"/{prefix}{name}",
            TRIGGER,
            _triggered(act),
            refuse=lambda why: TRIGGER.response(False, why),
            why_not=_why_not_armed if name == "arm" else lambda _attachment: "",
        )
        for name, act in acts.items()
    ]


def _why_not_armed(attachment: bytes) -> str:
    """A network that stalls may deliver a request long after somebody has given it up."""
    return why_request_too_old(attachment, time.time_ns())


def _triggered(act: Callable[[], str]) -> Callable[[Any], bytes]:
    return lambda _request: TRIGGER.response(*told(act))


def _stop(link: Link) -> str:
    said: list[str] = []
    if estop(RobotSelection(link.endpoint, link.namespace, link.session), said.append):
        raise RefusedError(*said)
    return "; ".join(said)


def _arm(session: Session, link: Link) -> str:
    """The robot and the backend that it has now; its name is that of the bridge's own."""
    robot = session.latest(keys.DESCRIPTION, Description, DESCRIBED_S)
    if robot is None:
        raise NotConnectedError(f"{link.namespace} publishes no description; is its HAL host running?")
    session.latest(keys.STATUS, Status, READY_S, lambda status: status.ready_to_arm)  # else the host says why not
    return _ask(session, link, request_to_arm(robot, WHO), "armed")


def _ask(session: Session, link: Link, request: LifecycleRequest, done: str) -> str:
    said: list[str] = []
    ask_host(session, keys.LIFECYCLE, request, done, link, said.append)
    return "; ".join(said)
