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
from snakesim_hal.network.stop_port import Address, StopAnswer, find_stop_address, request_stop
from snakesim_operator.base.robot_selection import RobotSelection
from snakesim_operator.robot_commands.stop_result import StopResult

STOP_TIMEOUT_S = 5.0
RobotAddress = tuple[str, str | None]  # endpoint and namespace of a robot
# Raises NotConnectedError when the port is closed.
RequestStopAtPort = Callable[[Address], StopAnswer | None]


def stop_robots(selection: RobotSelection, print_text: PrintLine = print_line) -> int:
    """Stop the addressed robots in every way at once, and print the result for each robot.

    Each robot is stopped by datagrams to its stop port and by a query over its network. Either is enough.

    Args:
        selection: Selects the robots.
        print_text: Prints a line for the operator.

    Returns:
        0 if every known robot has confirmed that it is stopped, otherwise 1.
    """
    local_ports = find_local_stop_ports(selection)
    remote_ports = find_remote_stop_ports(selection, local_ports)

    def request_by_datagram(address: Address) -> StopAnswer | None:
        return request_stop(*address, get_user_name(), STOP_TIMEOUT_S)

    with ThreadPoolExecutor(2 * len(local_ports) + len(remote_ports) + 1) as pool:
        local_futures = [
            pool.submit(request_stop_at_port, request_by_datagram, address, robot)
            for address, robot in local_ports.items()
        ]
        remote_futures = [
            pool.submit(request_stop_at_port, request_by_datagram, address, robot)
            for address, robot in remote_ports.items()
        ]
        # This import takes a while. The threads send their datagrams meanwhile.
        from snakesim_operator.robot_commands.stop_by_query import request_stop_on_network

        network_futures = [
            pool.submit(request_stop_on_network, link, STOP_TIMEOUT_S)
            for link in selection.list_networks()
        ]
        local_results = _collect_results(local_futures)
        remote_results = _collect_results(remote_futures)
        network_results = [result for future in network_futures for result in future.result()]
    results = combine_results(local_results, remote_results, network_results)
    for line in describe_results(results, local_results, network_results):
        print_text(line)
    if not results:
        print_text(
            f"no robot on {', '.join(selection.list_endpoints())}, and none that this user runs on this computer"
        )
    if selection.namespace is not None and not any(result.is_stopped for result in results):
        _print_other_robots(selection, print_text)
    return 0 if are_all_stopped(results) else 1


def _collect_results(futures: Sequence[Future[StopResult | None]]) -> list[StopResult]:
    """Wait for the results of stop ports, and leave out those of closed ports, which are None."""
    results = [future.result() for future in futures]
    return [result for result in results if result is not None]


def _print_other_robots(selection: RobotSelection, print_text: PrintLine) -> None:
    """Print the robots on the network, because the operator may have typed a wrong name."""
    from snakesim_operator.base.targets import find_robots

    for link in find_robots(replace(selection, namespace=None)):
        print_text(
            f"there is {link.namespace}, on {link.endpoint}; `snakesim estop` without --namespace stops all"
        )


def find_local_stop_ports(selection: RobotSelection) -> dict[Address, RobotAddress]:
    """Return the stop ports of the selected robots that run on this computer, as listed in the local registry."""
    ports: dict[Address, RobotAddress] = {}
    for robot in selection.list_local_robots():
        ports[robot.stop_host, robot.stop_port] = (robot.endpoint, robot.namespace)
    return ports


def find_remote_stop_ports(
    selection: RobotSelection, local_ports: dict[Address, RobotAddress]
) -> dict[Address, RobotAddress]:
    """Return the stop port that belongs to the selected endpoint, if no robot of this computer is selected.

    Args:
        selection: Selects the robots.
        local_ports: Stop ports of the selected robots on this computer.

    Returns:
        At most one stop port, with its robot; empty without an endpoint, or if a router listens at the endpoint.
    """
    if selection.endpoint is None or local_ports:
        return {}
    if selection.session is not None:  # a router listens at a session's endpoint
        return {}
    address = find_stop_address(selection.endpoint, listens=True)
    _, port = address
    if not port:
        return {}
    return {address: (selection.endpoint, selection.namespace)}


def request_stop_at_port(
    request_stop_by_datagram: RequestStopAtPort, address: Address, robot: RobotAddress
) -> StopResult | None:
    """Send a stop request to a stop port, and wait for the answer.

    Args:
        request_stop_by_datagram: Sends the request, and returns the answer; None if there is no answer in time.
        address: Host and port of the stop port.
        robot: Endpoint and namespace of the robot.

    Returns:
        The result, or None if the port is closed.
    """
    endpoint, namespace = robot
    try:
        answer = request_stop_by_datagram(address)
    except NotConnectedError:
        return None
    if answer is not None:
        return StopResult(answer.robot, endpoint, is_stopped=True, text=answer.text)
    text = f"NO ANSWER at udp/{address[0]}:{address[1]} for {STOP_TIMEOUT_S:g} s: use its own emergency stop"
    return StopResult(namespace or "a robot", endpoint, is_stopped=False, text=text)


def combine_results(
    local_results: Sequence[StopResult],
    remote_results: Sequence[StopResult],
    network_results: Sequence[StopResult],
) -> list[StopResult]:
    """Combine the results of stop ports and of queries over the network to one result for each robot.

    Args:
        local_results: Results of stop ports of this computer.
        remote_results: Results of stop ports of other computers, which count only if the network confirms them.
        network_results: Results of queries over the network.
    """
    port_results = (*local_results, *remote_results)
    network_only_results = [
        result
        for result in network_results
        if not any(_is_same_robot(result, other) for other in port_results)
    ]
    return [
        *local_results,
        *_confirm_remote_results(remote_results, network_results),
        *network_only_results,
    ]


def describe_results(
    results: Sequence[StopResult],
    local_results: Sequence[StopResult],
    network_results: Sequence[StopResult],
) -> list[str]:
    """Return a line for each robot, and a warning for each robot for which an impostor may answer on the network.

    A robot of this computer may have a result of both ways. Its line shows that of its stop port, which an impostor
    cannot forge, so a doubtful result of the network is shown as a warning in addition.

    Args:
        results: One result for each robot, which `combine_results` has made of the results of all ways.
        local_results: Results of stop ports of this computer.
        network_results: Results of queries over the network. They are doubtful if more than one host answers in the
            robot's name.
    """
    lines: list[str] = []
    for result in results:
        state = "stopped" if result.is_stopped else "NOT STOPPED"
        lines.append(f"{result.name}: {state}: {result.text} ({result.endpoint})")
    for result in network_results:
        has_local_result = any(_is_same_robot(result, other) for other in local_results)
        if result.is_doubtful and has_local_result:
            lines.append(f"{result.name}: WARNING: {result.text} ({result.endpoint})")
    return lines


def are_all_stopped(results: Sequence[StopResult]) -> bool:
    """Return whether there are robots, and every one has confirmed that it is stopped."""
    return bool(results) and all(result.is_stopped for result in results)


def _confirm_remote_results(
    remote_results: Sequence[StopResult], network_results: Sequence[StopResult]
) -> list[StopResult]:
    """Check the results of remote stop ports against those of the network, because a remote port may be forged.

    A port that reports a stop counts as "not stopped" unless the network confirms the stop. A port that does not
    answer is left out if the network confirms the stop, because a router's address may have no stop port.

    Args:
        remote_results: Results of stop ports of other computers.
        network_results: Results of queries over the network.

    Returns:
        The checked results of the stop ports.
    """
    confirmed_results: list[StopResult] = []
    for result in remote_results:
        is_confirmed = any(
            _is_same_robot(result, other) and other.is_stopped for other in network_results
        )
        if result.is_stopped and is_confirmed:
            confirmed_results.append(result)
        elif result.is_stopped:
            text = (
                f"its stop port reports it, but nothing on its network confirms it: {result.text}"
            )
            confirmed_results.append(replace(result, is_stopped=False, text=text))
        elif not is_confirmed:
            confirmed_results.append(result)
    return confirmed_results


def _is_same_robot(a: StopResult, b: StopResult) -> bool:
    """Return whether two results are of the robot with the same name at the same endpoint."""
    return (a.endpoint, a.name) == (b.endpoint, b.name)
