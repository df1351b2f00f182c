"""`snakesim estop`: stop a robot now, or without a name every reachable one.

Two ways at once, until one is answered or five seconds have passed: each robot's stop port, which floods and full
sessions do not block, and the network, for robots behind a lab's router. The datagrams leave before anything of the
network is even imported, which takes seconds on a machine that is busy.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from snakesim_hal.errors import NotConnectedError
from snakesim_hal.network.stop_port import ask_to_stop, stop_address
from snakesim_hal.process import user_name
from snakesim_hal.terminal import Say, say
from snakesim_operator.tools.robot_selection import RobotSelection
from snakesim_operator.tools.stop_result import StopResult

LIMIT_S = 5.0
Address = tuple[str, int]  # of a stop port


def estop(where: RobotSelection, say: Say = say) -> int:
    """Stop them. Returns 0 when every known robot has confirmed that it is stopped."""
    local = {(robot.stop_host, robot.stop_port): (robot.endpoint, robot.namespace) for robot in where.local()}
    elsewhere: dict[Address, tuple[str, str | None]] = {}
    if where.endpoint is not None and where.session is None and not local:  # at a session's endpoint is a router
        address = stop_address(where.endpoint, listens=True)
        elsewhere |= {address: (where.endpoint, where.namespace)} if address[1] else {}
    with ThreadPoolExecutor(2 * len(local) + len(elsewhere) + 1) as side_by_side:
        asked_here = [side_by_side.submit(_at_port, address, *robot) for address, robot in local.items()]
        asked_there = [side_by_side.submit(_at_port, address, *robot) for address, robot in elsewhere.items()]
        from snakesim_operator.tools.stop_by_query import ask_network  # only now: the datagrams are on their way

        asked_all = [side_by_side.submit(ask_network, link, LIMIT_S) for link in where.networks()]
        here = [result for future in asked_here if (result := future.result()) is not None]
        there = [result for future in asked_there if (result := future.result()) is not None]
        shown = [result for future in asked_all for result in future.result()]
    only_there = [result for result in shown if not any(_same(result, other) for other in (*here, *there))]
    results = [*here, *_confirmed(there, shown), *only_there]
    for robot in results:
        say(f"{robot.name}: {'stopped' if robot.stopped else 'NOT STOPPED'}: {robot.text} ({robot.endpoint})")
    for robot in shown:
        if robot.in_doubt and any(_same(robot, other) for other in here):
            say(f"{robot.name}: WARNING: {robot.text} ({robot.endpoint})")
    if not results:
        say(f"no robot on {', '.join(where.endpoints())}, and none that this user runs on this computer")
    if where.namespace is not None and not any(robot.stopped for robot in results):
        from snakesim_operator.tools.targets import find_robots

        for link in find_robots(replace(where, namespace=None)):
            say(f"there is {link.namespace}, on {link.endpoint}; `snakesim estop` without --namespace stops all")
    return 0 if results and all(robot.stopped for robot in results) else 1


def _confirmed(there: list[StopResult], shown: list[StopResult]) -> list[StopResult]:
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


def _at_port(address: Address, endpoint: str, namespace: str | None) -> StopResult | None:
    """Send a stop to a stop port; None when the port is closed."""
    try:
        answer = ask_to_stop(*address, user_name(), LIMIT_S)
    except NotConnectedError:
        return None
    if answer is not None:
        return StopResult(answer.robot, endpoint, stopped=True, text=answer.text)
    text = f"NO ANSWER at udp/{address[0]}:{address[1]} for {LIMIT_S:g} s: use its own emergency stop"
    return StopResult(namespace or "a robot", endpoint, stopped=False, text=text)
