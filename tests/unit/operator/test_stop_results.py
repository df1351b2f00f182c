"""Combines the results of stop ports and of the network to one emergency stop result for each robot."""

from snakesim_operator.robot_commands.stop import combine_results, describe_results
from snakesim_operator.robot_commands.stop_result import StopResult

ENDPOINT = "tcp/10.0.0.2:7447"


def make_result(*, is_stopped: bool, is_doubtful: bool = False) -> StopResult:
    """Make the result of a stop of the robot `snake`."""
    return StopResult("snake", ENDPOINT, is_stopped, "a text", is_doubtful)


def test_remote_stop_without_network_confirmation_is_not_stopped() -> None:
    """The stop port of another computer may be an impostor's, so its answer alone is not enough."""
    reported_by_port = make_result(is_stopped=True)
    (combined,) = combine_results(
        local_results=[], remote_results=[reported_by_port], network_results=[]
    )
    assert not combined.is_stopped
    assert "nothing on its network confirms it" in combined.text


def test_remote_stop_confirmed_by_the_network_is_stopped() -> None:
    reported_by_port = make_result(is_stopped=True)
    reported_by_network = make_result(is_stopped=True)
    combined = combine_results(
        local_results=[],
        remote_results=[reported_by_port],
        network_results=[reported_by_network],
    )
    assert combined == [reported_by_port]


def test_closed_remote_port_is_omitted_if_network_confirms_stop() -> None:
    closed_port = make_result(is_stopped=False)
    unconfirmed = combine_results(
        local_results=[], remote_results=[closed_port], network_results=[]
    )
    assert unconfirmed == [closed_port]
    confirmed = combine_results(
        local_results=[],
        remote_results=[closed_port],
        network_results=[make_result(is_stopped=True)],
    )
    assert confirmed == []


def test_doubtful_network_result_adds_warning_to_local_stop() -> None:
    local = make_result(is_stopped=True)
    doubtful = make_result(is_stopped=True, is_doubtful=True)
    results = combine_results(local_results=[local], remote_results=[], network_results=[doubtful])
    lines = describe_results(results, local_results=[local], network_results=[doubtful])
    assert [line.split(":")[1].strip() for line in lines] == ["stopped", "WARNING"]
