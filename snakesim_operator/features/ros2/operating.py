"""Offers arm, disarm, reset and stop as ROS services, with the same requests as `snakesim robot`."""

import time
from collections.abc import Callable
from typing import Any

from snakesim_hal.base.errors import NotConnectedError, RefusedError
from snakesim_hal.base.process import get_user_name
from snakesim_hal.network.session import ConnectionSettings, Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    LifecycleRequest,
    RobotDescription,
    RobotStatus,
    make_arm_request,
)
from snakesim_operator.base.robot_selection import RobotSelection
from snakesim_operator.features.ros2.graph import RosNode
from snakesim_operator.features.ros2.message_age import explain_stale_request
from snakesim_operator.features.ros2.server import ServiceServer, run_action
from snakesim_operator.features.ros2.service_types import TRIGGER
from snakesim_operator.robot_commands.command import request_from_host
from snakesim_operator.robot_commands.stop import stop_robots

DESCRIPTION_TIMEOUT_S = 3.0
READY_TIMEOUT_S = 5.0  # a controller may be starting
REQUESTER = f"{get_user_name()[:40]}, ros2"


def make_operating_servers(
    session: Session, node: RosNode, connection: ConnectionSettings, prefix: str, *, operate: bool
) -> list[ServiceServer]:
    """Declare the ROS services that stop the robot and, if ROS may operate it, arm, disarm and reset it.

    Args:
        session: Session on the robot's network.
        node: The ROS node that offers them.
        connection: Addresses and certificates with which the robot is reached.
        prefix: Namespace of the services, with a slash behind it, or empty.
        operate: Whether ROS may arm, disarm and reset; stop is always offered.
    """
    operator = _RobotOperator(session, connection)
    servers = [_make_trigger_server(node, f"/{prefix}stop", operator.stop)]
    if operate:
        arm = ServiceServer(
            node,
            f"/{prefix}arm",
            TRIGGER,
            _make_trigger_handler(operator.arm),
            make_refusal=_make_trigger_refusal,
            explain_refusal=_explain_late_arm_request,
        )
        disarm = _make_trigger_server(node, f"/{prefix}disarm", operator.disarm)
        reset = _make_trigger_server(node, f"/{prefix}reset", operator.reset)
        servers += [arm, disarm, reset]
    return servers


def _make_trigger_server(node: RosNode, name: str, action: Callable[[], str]) -> ServiceServer:
    return ServiceServer(
        node, name, TRIGGER, _make_trigger_handler(action), make_refusal=_make_trigger_refusal
    )


def _make_trigger_handler(action: Callable[[], str]) -> Callable[[Any], bytes]:
    def answer(_request: Any) -> bytes:
        succeeded, text = run_action(action)
        return TRIGGER.encode_response(succeeded, text)

    return answer


def _make_trigger_refusal(reason: str) -> bytes:
    return TRIGGER.encode_response(False, reason)


def _explain_late_arm_request(attachment: bytes) -> str:
    """Return why a request to arm is refused; empty if it is allowed.

    A network that stalls may deliver a request long after the client has stopped waiting.
    """
    return explain_stale_request(attachment, time.time_ns())


class _RobotOperator:
    """Sends the requests of the services to the robot. Each method returns the robot's answer in words."""

    def __init__(self, session: Session, connection: ConnectionSettings) -> None:
        self._session = session
        self._connection = connection

    def stop(self) -> str:
        """Stop the robot by `snakesim estop`. Raises RefusedError if the robot does not confirm it."""
        lines: list[str] = []
        robot = RobotSelection(
            self._connection.endpoint, self._connection.namespace, self._connection.session
        )
        exit_code = stop_robots(robot, lines.append)
        if exit_code != 0:
            raise RefusedError(*lines)
        return "; ".join(lines)

    def arm(self) -> str:
        """Arm the robot that the host describes at present."""
        robot = self._session.wait_for_latched(
            keys.DESCRIPTION, RobotDescription, DESCRIPTION_TIMEOUT_S
        )
        if robot is None:
            raise NotConnectedError(
                f"{self._connection.namespace} publishes no description; is its HAL host running?",
                code="network/no-robot",
            )
        # If it does not become ready, the host's answer to the request gives the reason.
        self._session.wait_for_latched(
            keys.STATUS, RobotStatus, READY_TIMEOUT_S, lambda status: status.ready_to_arm
        )
        return self._send_lifecycle_request(make_arm_request(robot, REQUESTER), "armed")

    def disarm(self) -> str:
        """Disarm the robot."""
        return self._send_lifecycle_request(
            LifecycleRequest(action="disarm", requester=REQUESTER), "disarmed"
        )

    def reset(self) -> str:
        """Reset the robot's fault."""
        return self._send_lifecycle_request(
            LifecycleRequest(action="reset", requester=REQUESTER), "reset"
        )

    def _send_lifecycle_request(self, request: LifecycleRequest, done: str) -> str:
        lines: list[str] = []
        request_from_host(
            self._session, keys.LIFECYCLE, request, done, self._connection, lines.append
        )
        return "; ".join(lines)
