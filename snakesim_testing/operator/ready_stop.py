"""A stop that is always ready, for a console without a robot."""

from concurrent.futures import Future

from snakesim_operator.robot_commands.prepared_stop import StopReadiness


class ReadyStop:
    """Answers each request at once, and counts them."""

    def __init__(self) -> None:
        self.requesters: list[str] = []

    def request(self, requester: str) -> "Future[str]":
        self.requesters.append(requester)
        stopped: Future[str] = Future()
        stopped.set_result("stopped")
        return stopped

    def readiness(self) -> StopReadiness:
        return StopReadiness(ready=True, text="ready")

    def test_if_due(self) -> None:
        """It is."""
