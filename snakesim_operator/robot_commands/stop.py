"""`snakesim estop`: stop a robot now, or without a name every reachable one.

Two ways at once, until one is answered or five seconds have passed: each robot's stop port, which floods and full
sessions do not block, and the network, for robots behind a lab's router. The datagrams leave before anything of the
network is even imported, which takes seconds on a machine that is busy.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.base.process import user_name
from snakesim_hal.base.terminal import Say, say
from snakesim_hal.network.stop_port import Address, Stopped, ask_to_stop, stop_address
from snakesim_operator.base.robot_selection import RobotSelection
from snakesim_operator.robot_commands.stop_result import StopResult

LIMIT_S = 5.0
Named = tuple[str, str | None]  # endpoint and namespace of a robot
AskPort = Callable[[Address], Stopped | None]  # raises NotConnectedError when the port is closed


def estop(where: RobotSelection, say: Say = say) -> int:
    """Stop them. Returns 0 when every known robot has confirmed that it is stopped."""
    local = local_stop_ports(where)
    elsewhere = stop_ports_elsewhere(where, local)

    def ask(address: Address) -> Stopped | None:
        return ask_to_stop(*address, user_name(), LIMIT_S)

    with ThreadPoolExecutor(2 * len(local) + len(elsewhere) + 1) as side_by_side:
        asked_here = [side_by_side.submit(stop_at_port, ask, address, robot) for address, robot in local.items()]
        asked_there = [side_by_side.submit(stop_at_port, ask, address, robot) for address, robot in elsewhere.items()]
        from snakesim_operator.robot_commands.stop_by_query import (
            ask_network,  # only now: the datagrams are on their way
        )

        asked_all = [side_by_side.submit(ask_network, link, LIMIT_S) for link in where.networks()]
        here = [result for future in asked_here if (result := future.result()) is not None]
        there = [result for future in asked_there if (result := future.result()) is not None]
        shown = [result for future in asked_all for result in future.result()]
    results = combine_results(here, there, shown)
    for line in describe_results(results, here, shown):
        say(line)
    if not results:
        say(f"no robot on {', '.join(where.endpoints())}, and none that this user runs on this computer")
    if where.namespace is not None and not any(robot.stopped for robot in results):
        from snakesim_operator.base.targets import find_robots

        for link in find_robots(replace(where, namespace=None)):
            say(f"there is {link.namespace}, on {link.endpoint}; `snakesim estop` without --namespace stops all")
    return 0 if all_stopped(results) else 1


def local_stop_ports(where: RobotSelection) -> dict[Address, Named]:
    """Return the stop ports of the addressed robots that run on this computer, as the registry has them."""
    return {(robot.stop_host, robot.stop_port): (robot.endpoint, robot.namespace) for robot in where.local()}


def stop_ports_elsewhere(where: RobotSelection, local: dict[Address, Named]) -> dict[Address, Named]:
    """Return the stop port beside the given endpoint, when no robot of this computer is meant by it."""
    if where.endpoint is None or where.session is not None or local:  # at a session's endpoint is a router
        return {}
    address = stop_address(where.endpoint, listens=True)
    return {address: (where.endpoint, where.namespace)} if address[1] else {}


def stop_at_port(ask: AskPort, address: Address, robot: Named) -> StopResult | None:
    """Send a stop to a stop port; None when the port is closed."""
    endpoint, namespace = robot
    try:
        answer = ask(address)
    except NotConnectedError:
        return None
    if answer is not None:
        return StopResult(answer.robot, endpoint, stopped=True, text=answer.text)
    text = f"NO ANSWER at udp/{address[0]}:{address[1]} for {LIMIT_S:g} s: use its own emergency stop"
    return StopResult(namespace or "a robot", endpoint, stopped=False, text=text)


def combine_results(
    here: Sequence[StopResult], there: Sequence[StopResult], shown: Sequence[StopResult]
) -> list[StopResult]:
    """Return one result for each robot.

    Args:
        here: Results of stop ports of this computer.
        there: Results of stop ports of other computers, which count once the robot's network confirms them.
        shown: Results of the network.
    """
    only_shown = [result for result in shown if not any(_same(result, other) for other in (*here, *there))]
    return [*here, *_confirmed(there, shown), *only_shown]


def describe_results(
    results: Sequence[StopResult], here: Sequence[StopResult], shown: Sequence[StopResult]
) -> list[str]:
    """Return a line for each robot, and one for each that an impostor may answer for on the network."""
    lines = [
        f"{robot.name}: {'stopped' if robot.stopped else 'NOT STOPPED'}: {robot.text} ({robot.endpoint})"
        for robot in results
    ]
    doubtful = [robot for robot in shown if robot.in_doubt and any(_same(robot, other) for other in here)]
    return lines + [f"{robot.name}: WARNING: {robot.text} ({robot.endpoint})" for robot in doubtful]


def all_stopped(results: Sequence[StopResult]) -> bool:
    """Whether there are robots, and every one has confirmed that it is stopped."""
    return bool(results) and all(robot.stopped for robot in results)


def _confirmed(there: Sequence[StopResult], shown: Sequence[StopResult]) -> list[StopResult]:
    """Answers of stop ports of other computers, once the robot's network confirms them: such a port may be forged.

    A silent port counts for nothing when the network confirms the stop: at a router's address there may be none.
    """
    return [
        result
        if not result.stopped or any(_same(result, other) and other.stopped for other in shown)
        else replace(
            result,
            stopped=False,
            text=f"its stop port reports it, but nothing on its network confirms it: {result.text}",
        )
        for result in there
        if result.stopped or not any(_same(result, other) and other.stopped for other in shown)
    ]


def _same(a: StopResult, b: StopResult) -> bool:
    return (a.endpoint, a.name) == (b.endpoint, b.name)
