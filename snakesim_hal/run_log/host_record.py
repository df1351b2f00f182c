"""The names of the files in a host's record, and the statistics in `host.json`."""

from typing import Literal

import msgspec

from snakesim_hal.wire.messages import Fault, TimingStatistics

BLACK_BOX = "blackbox.rows"
DESCRIPTION = "description.json"
HOST_RECORD = "host.json"
# Not yet; after the requested armed ticks; on request (`finish`); by a signal; by a fault, or too little armed time;
# for another host that starts over.
Ending = Literal["running", "complete", "finished", "stopped", "failed", "reset"]


class HostRecord(msgspec.Struct, frozen=True, kw_only=True):
    """`host.json`: the host's statistics of the run, written twice a second while it runs, and at the end."""

    ticks: int  # recorded: from the first arming on
    wall_s: float
    overruns: int
    answered_ticks: int
    armed_ticks: int
    command_digest: str
    state_to_command_us: dict[str, float | None]
    tick_times: dict[str, TimingStatistics] = {}  # as in `hal/status`
    rejected_commands: dict[str, int]
    limited_commands: dict[str, int]
    faults: list[Fault]
    lifecycle: str
    reason: str
    ended: Ending = "complete"
    ending_reason: str = ""  # unless complete
    lost_ticks: int = 0  # missing from the black box on disk
    failure: str = ""  # which files could not be written, and why
    faults_left_out: int = 0  # of `faults`, in the middle
    injected: list[str] = []  # injected faults, each begin and end
    requests: list[str] = []  # to arm, disarm, clear, finish or stop: by whom, and the result
    isolated: list[str] = []  # joints that were isolated at the end
