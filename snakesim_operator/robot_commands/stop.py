"""`snakesim estop`: stops a robot now, or without a name every reachable robot.

It uses two ways at once, until one is answered or five seconds have passed: each robot's stop port, which floods and
full sessions do not block, and the network, for robots behind a lab's router. The datagrams to the stop ports are sent
before the network modules are even imported, which takes seconds on a busy machine.
"""

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.base.process import get_user_name
from snakesim_hal.base.terminal import PrintLine, print_line
from snakesim_hal.network.stop_port import Address, StopAnswer, request_stop, stop_address
from snakesim_operator.base.robot_selection import RobotSelection
from snakesim_operator.robot_commands.stop_result import StopResult

LIMIT_S = 5.0
Named = tuple[str, str | None]  # endpoint and namespace of a robot
AskPort = Callable[[Address], StopAnswer | None]  # raises NotConnectedError when the port is closed


def estop(where: RobotSelection, print_text: PrintLine = print_line) -> int:
    """Stop the addressed robots in every way at once, and print the result for each robot.

    Each robot is stopped by datagrams to its stop port and by a query over its network. Either is enough.

    Args:
        where: Selects the robots.
        print_text: Prints a line for the operator.

    Returns:
        0 if every known robot has confirmed that it is stopped, otherwise 1.
    """
    local_ports = local_stop_ports(where)
    remote_ports = stop_ports_elsewhere(where, local_ports)

    def request(address: Address) -> StopAnswer | None:
        return request_stop(*address, get_user_name(), LIMIT_S)

    with ThreadPoolExecutor(2 * len(local_ports) + len(remote_ports) + 1) as pool:
        local_futures = [pool.submit(stop_at_port, request, address, robot) for address, robot in local_ports.items()]
        remote_futures = [pool.submit(stop_at_port, request, address, robot) for address, robot in remote_ports.items()]
        # This import takes a while. The threads send their datagrams meanwhile.
        from snakesim_operator.robot_commands.stop_by_query import ask_network

        network_futures = [pool.submit(ask_network, link, LIMIT_S) for link in where.networks()]
        local_results = _collect(local_futures)
        remote_results = _collect(remote_futures)
        network_results = [result for future in network_futures for result in future.result()]
    results = combine_results(local_results, remote_results, network_results)
    for line in describe_results(results, local_results, network_results):
        print_text(line)
    if not results:
        print_text(f"no robot on {', '.join(where.endpoints())}, and none that this user runs on this computer")
    if where.namespace is not None and not any(robot.stopped for robot in results):
        _print_other_robots(where, print_text)
    return 0 if all_stopped(results) else 1


def _collect(futures: Sequence[Future[StopResult | None]]) -> list[StopResult]:
    """Wait for the answers of stop ports; closed ports are left out."""
    results = [future.result() for future in futures]
    return [result for result in results if result is not None]


def _print_other_robots(where: RobotSelection, print_text: PrintLine) -> None:
    """Print which robots there are, because the operator may have typed a wrong name."""
    from snakesim_operator.base.targets import find_robots

    for link in find_robots(replace(where, namespace=None)):
        print_text(f"there is {link.namespace}, on {link.endpoint}; `snakesim estop` without --namespace stops all")


def local_stop_ports(where: RobotSelection) -> dict[Address, Named]:
    """Return the stop ports of the addressed robots that run on this computer, as the registry has them."""
    ports: dict[Address, Named] = {}
    for robot in where.local():
        ports[robot.stop_host, robot.stop_port] = (robot.endpoint, robot.namespace)
    return ports


def stop_ports_elsewhere(where: RobotSelection, local: dict[Address, Named]) -> dict[Address, Named]:
    """Return the stop port beside the endpoint, if the endpoint is not that of a robot of this computer."""
    if where.endpoint is None or local:
        return {}
    if where.session is not None:  # a router listens at a session's endpoint
        return {}
    address = stop_address(where.endpoint, listens=True)
    _, port = address
    if not port:
        return {}
    return {address: (where.endpoint, where.namespace)}


def stop_at_port(ask: AskPort, address: Address, robot: Named) -> StopResult | None:
    """Send a stop to a stop port, and wait for the answer. Returns None when the port is closed."""
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
    by_ports = (*here, *there)
    only_shown = [result for result in shown if not any(_is_same_robot(result, other) for other in by_ports)]
    return [*here, *_check_remote_ports(there, shown), *only_shown]


def describe_results(
    results: Sequence[StopResult], here: Sequence[StopResult], shown: Sequence[StopResult]
) -> list[str]:
    """Return a line for each robot, and a warning for each robot for which an impostor may answer on the network."""
    lines: list[str] = []
    for robot in results:
        state = "stopped" if robot.stopped else "NOT STOPPED"
        lines.append(f"{robot.name}: {state}: {robot.text} ({robot.endpoint})")
    for robot in shown:
        if robot.in_doubt and any(_is_same_robot(robot, other) for other in here):
            lines.append(f"{robot.name}: WARNING: {robot.text} ({robot.endpoint})")
    return lines


def all_stopped(results: Sequence[StopResult]) -> bool:
    """Return whether there are robots, and every one has confirmed that it is stopped."""
    return bool(results) and all(robot.stopped for robot in results)


def _check_remote_ports(there: Sequence[StopResult], shown: Sequence[StopResult]) -> list[StopResult]:
    """Return the answers of stop ports of other computers, checked by those of the network: such a port may be forged.

    A port that reports a stop counts only when the network confirms it. A port that does not answer is left out when
    the network confirms the stop, because a router's address may have no stop port.
    """
    checked: list[StopResult] = []
    for result in there:
        is_confirmed = any(_is_same_robot(result, other) and other.stopped for other in shown)
        if result.stopped and is_confirmed:
            checked.append(result)
        elif result.stopped:
            text = f"its stop port reports it, but nothing on its network confirms it: {result.text}"
            checked.append(replace(result, stopped=False, text=text))
        elif not is_confirmed:
            checked.append(result)
    return checked


def _is_same_robot(a: StopResult, b: StopResult) -> bool:
    return (a.endpoint, a.name) == (b.endpoint, b.name)
