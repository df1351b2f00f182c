"""How the run of a host ends."""

from snakesim_hal.run_log.host_record import Ending


class RequestedEnding:
    """The end of one run, once it has been requested. The first reason counts."""

    def __init__(self) -> None:
        self.requested = False
        self.status: Ending = "running"
        self.reason = ""

    def request(self, status: Ending, reason: str = "") -> None:
        """End the run at the next opportunity. May be called from a signal handler."""
        if self.status == "running":
            self.status = status
            self.reason = reason
        self.requested = True
