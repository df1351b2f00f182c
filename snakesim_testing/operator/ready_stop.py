"""An emergency stop that is always ready, for tests of a console without a robot."""

from concurrent.futures import Future

from snakesim_operator.robot_commands.prepared_stop import StopReadiness


class ReadyStop:
    """An emergency stop that confirms each request at once, and keeps the names of the requesters."""

    def __init__(self) -> None:
        self.requesters: list[str] = []

    def request_stop(self, requester: str) -> "Future[str]":
        """Keep the name of the requester, and confirm the stop."""
        self.requesters.append(requester)
        confirmation: Future[str] = Future()
        confirmation.set_result("stopped")
        return confirmation

    def check_readiness(self) -> StopReadiness:
        """Report that the stop is ready."""
        return StopReadiness(is_ready=True, text="ready")

    def start_self_test_if_due(self) -> None:
        """Start no self-test, because this stop needs none."""
