"""Combines the results of stop ports and of the network to one emergency stop result for each robot."""

from snakesim_operator.robot_commands.stop import combine_results, describe_results
from snakesim_operator.robot_commands.stop_result import StopResult

ENDPOINT = "tcp/10.0.0.2:7447"


def make_result(*, is_stopped: bool, is_doubtful: bool = False) -> StopResult:
    """Make the result of a stop of the robot `snake`."""
    return StopResult("snake", ENDPOINT, is_stopped, "a text", is_doubtful)


def test_remote_stop_counts_only_if_the_network_confirms_it() -> None:
    remote = make_result(is_stopped=True)
    (unconfirmed,) = combine_results([], [remote], [])
    assert not unconfirmed.is_stopped
    assert "nothing on its network confirms it" in unconfirmed.text
    assert combine_results([], [remote], [make_result(is_stopped=True)]) == [remote]


def test_closed_remote_port_is_omitted_if_network_confirms_stop() -> None:
    closed_port = make_result(is_stopped=False)
    assert combine_results([], [closed_port], []) == [closed_port]
    assert combine_results([], [closed_port], [make_result(is_stopped=True)]) == []


def test_doubtful_network_result_adds_warning_to_local_stop() -> None:
    local = make_result(is_stopped=True)
    doubtful = make_result(is_stopped=True, is_doubtful=True)
    results = combine_results([local], [], [doubtful])
    lines = describe_results(results, [local], [doubtful])
    assert [line.split(":")[1].strip() for line in lines] == ["stopped", "WARNING"]
