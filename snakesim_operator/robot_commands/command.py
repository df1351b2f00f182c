"""Commands to a robot: `snakesim robot arm`, `disarm`, `reset`, `sim`.

A name is not an identity: any client on the network can answer in a robot's name. So all hosts are queried, two answers
are an error, and an answer is accepted once the robot's host publishes the new state itself.
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

from snakesim_hal.base.errors import NotConnectedError, RefusedError
from snakesim_hal.base.process import get_user_name
from snakesim_hal.base.terminal import PrintLine, print_line
from snakesim_hal.host.latch import find_latched_stops, remove_latched_stop
from snakesim_hal.network.session import Link, Session, open_session
from snakesim_hal.network.streams import Reader
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Answer, Description, LifecycleRequest, SimulatorRequest, Status, make_arm_request
from snakesim_operator.base.targets import CONNECT_S, RobotSelection, only_robot
from snakesim_operator.robot_commands.simulator_order import SimulatorOrder

ANSWER_S = 5.0
DESCRIPTION_S = 3.0
RETRY_S = 0.5  # between two attempts to arm
SHOWN_S = 1.5  # until the host's status must show what it answered
DONE = {"pause": "paused", "resume": "resumed", "step": "stepped", "speed": "changed", "reset": "reset"}


class NotReadyError(RefusedError):
    """The robot cannot be armed now, for a reason that can pass without an operator: a service is still starting."""


def arm(
    robot: str,
    backend: str,
    where: RobotSelection,
    print_text: PrintLine = print_line,
    *,
    unchecked: bool = False,
    wait_s: float = 0.0,
) -> int:
    """Arm a robot, if its name and its backend are those that the operator names.

    Args:
        robot: Expected name of the robot.
        backend: Expected backend of the robot.
        where: Selects the robot's network.
        print_text: Prints a line for the operator.
        unchecked: Whether to arm the robot even if its joints were not checked.
        wait_s: Time in which to try again while no robot answers, or while it is not ready. Other refusals end the
            wait, because only an operator can remove their cause.

    Returns:
        0, the exit code of the command.

    Raises:
        NotReadyError: The robot is not ready, at the end of the wait.
        RefusedError: Another robot or backend is there, or the host refuses.
        NotConnectedError: No robot answers, at the end of the wait.
    """
    deadline_s = time.monotonic() + wait_s
    reported = ""
    while True:
        try:
            return _arm_once(robot, backend, where, print_text, unchecked=unchecked)
        except (NotReadyError, NotConnectedError) as error:
            if time.monotonic() >= deadline_s:
                raise
            if str(error) != reported:
                reported = str(error)
                print_text(f"waiting: {reported}")
        time.sleep(RETRY_S)


def _arm_once(robot: str, backend: str, where: RobotSelection, print_text: PrintLine, *, unchecked: bool) -> int:
    """Send one request to arm a robot, if its name and its backend are those that the user typed.

    Args:
        robot: Name of the robot, as the user typed it.
        backend: Name of the backend, as the user typed it.
        where: Selects the robot.
        print_text: Prints a line.
        unchecked: Whether to arm although the joints were not checked.

    Returns:
        The exit code: 0 if the robot is armed.

    Raises:
        RefusedError: The robot or the backend has another name, or the host refuses.
    """
    link = only_robot(where, f"robot arm {robot} {backend}")
    with open_session(link, CONNECT_S) as session:
        description = _read_description(session, link)
        mismatches: list[str] = []
        if description.robot != robot:
            mismatches.append(f"the robot here is {description.robot!r}, not {robot!r}")
        if description.backend != backend:
            mismatches.append(f"the backend here is {description.backend!r}, not {backend!r}")
        if mismatches:
            raise RefusedError(
                f"not armed: {'; '.join(mismatches)}. To arm, name robot and backend: "
                f"`snakesim robot arm {description.robot} {description.backend}`",
                code="robot/wrong-robot",
            )
        request = make_arm_request(description, get_user_name(), unchecked=unchecked)
        return request_from_host(session, keys.LIFECYCLE, request, "armed", link, print_text)


def disarm(where: RobotSelection, print_text: PrintLine = print_line) -> int:
    """Make the joints passive; later commands do not move them. Returns the exit code."""
    request = LifecycleRequest(action="disarm", requester=get_user_name())
    return _request_from_robot(only_robot(where, "robot disarm"), keys.LIFECYCLE, request, "disarmed", print_text)


def reset(where: RobotSelection, print_text: PrintLine = print_line) -> int:
    """Reset a fault or an emergency stop of a robot, which is disarmed afterwards.

    If no robot runs, an emergency stop stored by the last run is removed.

    Args:
        where: Selects the robot.
        print_text: Prints a line.

    Returns:
        The exit code.
    """
    try:
        link = only_robot(where, "robot reset")
    except NotConnectedError:
        latched_stops = [path for path in find_latched_stops() if where.namespace in (None, path.parent.name)]
        if not latched_stops or where.endpoint is not None:
            raise
        for path in latched_stops:
            print_text(
                f"{path.parent.name}: {remove_latched_stop(path)}; reset by {get_user_name()}. No robot of "
                "that name runs here"
            )
        return 0
    return _request_from_robot(
        link, keys.LIFECYCLE, LifecycleRequest(action="reset", requester=get_user_name()), "reset", print_text
    )


def simulator(order: SimulatorOrder, where: RobotSelection, print_text: PrintLine = print_line) -> int:
    """Pause, step, speed up, slow down or reset a simulator. A robot that moves real hardware refuses.

    Returns the exit code.
    """
    request = SimulatorRequest(
        action=order.action, requester=order.requester or get_user_name(), ticks=order.ticks, speed=order.speed
    )
    return _request_from_robot(
        only_robot(where, f"sim {order}"), keys.SIMULATOR, request, DONE[order.action], print_text
    )


def _request_from_robot(
    link: Link, key: str, request: LifecycleRequest | SimulatorRequest, done: str, print_text: PrintLine
) -> int:
    with open_session(link, CONNECT_S) as session:
        return request_from_host(session, key, request, done, link, print_text)


def request_from_host(
    session: Session,
    key: str,
    request: LifecycleRequest | SimulatorRequest,
    done: str,
    link: Link,
    print_text: PrintLine,
) -> int:
    """Send a request to the robot's host, confirm the answer by the robot's status, and print it.

    Args:
        session: Session on the robot's network.
        key: Key at which the host answers.
        request: The request.
        done: What is done if the host accepts, in words, such as "armed".
        link: How the session reaches the robot, for messages.
        print_text: Prints a line for the operator.

    Returns:
        0, the exit code of the command.

    Raises:
        NotConnectedError: No host answers.
        RefusedError: The host refuses, or the status does not confirm the answer.
    """
    statuses = session.latched_reader(keys.STATUS, Status)
    answers = [answer for _, answer in session.request_all(key, request, ANSWER_S)]
    doubt, status = judge(answers, statuses)
    name = link.namespace
    if not answers:
        raise NotConnectedError(
            f"{name}: NO ANSWER on {link.endpoint}: its host hangs, or your role may not do this; if the "
            "robot moves, `snakesim estop`"
        )
    if doubt is not None:
        status_text = "unknown" if status is None else f"{status.lifecycle} - {status.reason}"
        raise RefusedError(
            f"{name}: NOT CONFIRMED that it is {done}: {doubt}. Its status: {status_text}", code="robot/not-confirmed"
        )
    answer = answers[0]
    if not answer.ok:
        refused = NotReadyError if answer.refusal == "not_ready" else RefusedError
        raise refused(f"{name}: not {done}: {answer.reason}")
    print_text(f"{name}: {done}: {answer.reason}")
    return 0


def request_while_driving(
    session: Session, request: LifecycleRequest, done: str, link: Link, turn: Callable[[], object]
) -> None:
    """Query the host, as `request_from_host`, and call `turn` meanwhile: an armed robot needs commands all the time."""
    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(request_from_host, session, keys.LIFECYCLE, request, done, link, lambda _line: None)
        while not answer.done():
            turn()
        answer.result()


def judge(answers: Sequence[Answer], statuses: Reader[Status]) -> tuple[str | None, Status | None]:
    """Check whether the robot's status confirms the answer of its host.

    An unauthorized process may answer in the host's name, or the host may answer and then hang.

    Args:
        answers: All answers to one request.
        statuses: Reads the status that the robot's host publishes.

    Returns:
        Why the answers are not confirmed, or None if one host answered and its status confirms it; and the newest
        status.
    """
    if len(answers) > 1:
        newest_status = _wait_for_status(statuses, None)
        return f"{len(answers)} answered in its name; at least one is an impostor", newest_status
    answered_lifecycle = answers[0].lifecycle if answers else None
    status = _wait_for_status(statuses, answered_lifecycle)
    hosts = {answer.host for answer in answers}
    if status is not None:
        hosts.add(status.host)
    if len(hosts) > 1:
        return "the answer is not from the host that publishes its status; one of them is an impostor", status
    if status is None or status.lifecycle != answered_lifecycle:
        return "its status does not show it; the host may hang, and the answer be from an impostor", status
    return None, status


def _wait_for_status(statuses: Reader[Status], lifecycle: str | None) -> Status | None:
    """Return the newest status, as soon as it shows a lifecycle state, or after SHOWN_S. None: any state counts."""
    shown: Status | None = None
    deadline = time.monotonic() + SHOWN_S
    while time.monotonic() < deadline:
        new_statuses = statuses.drain()
        if new_statuses:
            shown = new_statuses[-1]
        if shown is not None and lifecycle in (None, shown.lifecycle):
            break
        time.sleep(0.01)
    return shown


def _read_description(session: Session, link: Link) -> Description:
    """Read the description that the host of a robot publishes, and check that there is only one host.

    Args:
        session: Session on the robot's network.
        link: How to reach the robot, for messages.

    Raises:
        NotConnectedError: No host publishes a description.
        RefusedError: Several hosts publish one.
    """
    reader = session.latched_reader(keys.DESCRIPTION, Description)
    deadline = time.monotonic() + DESCRIPTION_S
    descriptions: list[Description] = []
    while not descriptions and time.monotonic() < deadline:
        time.sleep(0.05)
        descriptions = reader.drain()
    if not descriptions:
        raise NotConnectedError(
            f"{link.namespace} publishes no description on {link.endpoint}; is its HAL host running?",
            code="network/no-robot",
        )
    if len({description.host for description in descriptions}) > 1:
        count = len(descriptions)
        raise RefusedError(
            f"{link.namespace}: {count} hosts describe it; at least one is an impostor. Not armed",
            code="robot/several-hosts",
        )
    return descriptions[-1]
