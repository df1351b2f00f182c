"""A stop that is always ready, for a console without a robot."""

from concurrent.futures import Future

from snakesim_operator.robot_commands.prepared_stop import StopReadiness


class ReadyStop:
    """An emergency stop that confirms each request at once, and keeps the names of the requesters."""

    def __init__(self) -> None:
        self.requesters: list[str] = []

    def request_stop(self, requester: str) -> "Future[str]":
        self.requesters.append(requester)
        stopped: Future[str] = Future()
        stopped.set_result("stopped")
        return stopped

    def check_readiness(self) -> StopReadiness:
        return StopReadiness(is_ready=True, text="ready")

    def start_self_test_if_due(self) -> None:
        """It is."""
