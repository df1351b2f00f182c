"""The recorder: a process of its own beside a run, or beside any robot. A robot never waits for it in real time.

`python -m snakesim_operator.recording.process` is the child of `snakesim run`; `snakesim record` calls `record`.
"""

import argparse
import contextlib
import os
import sys
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import count
from pathlib import Path

import msgspec

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.process import on_stop_signal
from snakesim_hal.base.terminal import exit_code, print_stderr
from snakesim_hal.model.fault_kinds import HAL
from snakesim_hal.network.process_entries import own_entry, show_process
from snakesim_hal.network.run_key import is_proven, own_run_key
from snakesim_hal.network.session import Arrival, Link, open_session
from snakesim_hal.programs.arguments import add_network, add_parent, add_scenario
from snakesim_hal.programs.service_program import ProcessOptions, process_options
from snakesim_hal.service import START_LIMIT_S
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import Description
from snakesim_hal.wire.roles import RECORDER
from snakesim_operator.recording.message import RAW_ONLY, RECORDING
from snakesim_operator.recording.recording import Recording, Show
from snakesim_operator.recording.tap import Tap

TURN_S = 0.02
REST_S, QUIET_TURNS = 2.0, 2  # at the end: for as long at most; nothing must have come in so many turns
NICE = 10  # a robot's own processes come first
MAX_HOSTS = 100  # files: one for each host that a robot had
FULL = 4  # exit code: the disk took no more


class Recorder:
    """Writes what a tap takes; a file for each host that the robot has, one after the other."""

    def __init__(self, path: Path, shown_as: str | None, show: Show | None = None) -> None:
        """Arguments as of Recording. Raises OSError when the file cannot be made."""
        self.path = path
        self._shown_as = shown_as
        self._show = show
        self.recording = Recording(path, shown_as, show)
        self._latched: dict[str, Arrival] = {}
        self._host: str | None = None
        self._new_host = False
        self._back: Arrival | None = None  # the newest clock, if time went back and no file has begun since
        self._began = datetime.now(UTC)
        self._hosts = 1

    def take(self, arrival: Arrival) -> None:
        """Write one message."""
        if arrival.key in (keys.DESCRIPTION, keys.CONFIG, keys.STATUS):
            self._latched[arrival.key] = arrival
            if arrival.key == keys.DESCRIPTION:
                self._meet(arrival.payload)
        self.recording.take(arrival)
        if arrival.key == keys.CLOCK and (self._back is not None or self.recording.time.went_back):
            self._back = arrival
        if self._new_host and self._back is not None:  # in either order
            self._start_over(self._back)

    def close(self, dropped: dict[str, int]) -> str:
        """Finish the file. Returns why it lacks something, or an empty text."""
        about = {"version": version("snakesim"), "began": self._began.isoformat(), "dropped": dropped}
        self.recording.close(about)
        return self.recording.failure

    def _meet(self, payload: bytes) -> None:
        with contextlib.suppress(*UNDECODABLE):
            robot = msgspec.msgpack.decode(payload, type=Description)
            if is_proven(robot, own_run_key()):
                self._new_host |= self._host not in (None, robot.host)
                self._host = robot.host

    def _start_over(self, clock: Arrival) -> None:
        """Robot time started over, with another host: what was before gets a file of its own."""
        self._new_host, self._back = False, None
        if self._hosts >= MAX_HOSTS:
            return
        self._hosts += 1
        self.close({})
        self.path.rename(next(p for n in count(1) if not (p := self.path.with_stem(f"{self.path.stem}-{n}")).exists()))
        self.recording = Recording(self.path, self._shown_as, self._show)
        for arrival in (*self._latched.values(), clock):
            self.recording.take(arrival)


def record(
    link: Link,
    path: Path,
    goes_on: Callable[[], bool],
    show: Show | None = None,
    *,
    raw_only: bool = False,
    after_host: bool = False,
) -> Recorder:
    """Record a robot for as long as `goes_on` says. Raises NotConnectedError, ConfigError for a file that exists.

    raw_only: without topics for viewers, of which `show` would be told. after_host: then until its host has left."""
    try:
        recorder = Recorder(path, None if raw_only else link.namespace or "robot", show)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; choose another file") from error
    with open_session(link, connect_timeout_s=START_LIMIT_S) as session:
        tap, hosts = Tap(session), set[str]()
        session.on_alive(lambda key, there: (hosts.add if there else hosts.discard)(key), keys.alive(HAL))
        session.declare_alive(RECORDER)
        show_process(session, own_entry(RECORDER))
        while goes_on() and not recorder.recording.failure:
            _turn(tap, recorder)
            time.sleep(TURN_S)
        if after_host:
            _take_rest(tap, recorder, hosts)
        _turn(tap, recorder)
    for key, number in sorted(tap.dropped.items()):
        print_stderr(f"{number} messages on {key} were dropped: the disk was too slow")
    failure = recorder.close(dict(tap.dropped))
    if failure:
        print_stderr(f"recording ended: {failure}")
    return recorder


def _take_rest(tap: Tap, recorder: Recorder, hosts: set[str]) -> None:
    """What a host that has ended sent before, and what this process, which goes last, has not read yet."""
    give_up_s, quiet = time.monotonic() + REST_S, 0
    while quiet < QUIET_TURNS and time.monotonic() < give_up_s:
        quiet = 0 if _turn(tap, recorder) or hosts else quiet + 1
        time.sleep(TURN_S)


def _turn(tap: Tap, recorder: Recorder) -> int:
    """Write what has arrived; returns how many messages."""
    arrived = tap.take()
    for arrival in arrived:
        recorder.take(arrival)
    clock = recorder.recording.time.clock
    if clock is not None and not tap.dropped:
        tap.lossless = clock.clock_mode == "lockstep"
    recorder.recording.flush_when_due()
    return len(arrived)


def main(argv: Sequence[str] | None = None) -> int:
    """Record a run into its folder until told to end. Exit code 1 when it could not go on, 2 for wrong input."""
    parser = argparse.ArgumentParser(description="Record a run.")
    parser.add_argument("--out", type=Path, default=Path(), help="folder of the run")
    parser.add_argument("--raw-only", action="store_true", help=RAW_ONLY)
    add_scenario(parser)
    add_network(parser, "")
    add_parent(parser)
    arguments = parser.parse_args(argv)
    return exit_code(f"snakesim {RECORDER}", lambda: _record(process_options(arguments)))


def _record(given: ProcessOptions) -> int:
    ended: list[bool] = []
    on_stop_signal(lambda: ended.append(True))
    os.nice(NICE)
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))  # its threads, woken by each message, displace nobody
    file, raw_only = given.arguments.out / RECORDING, given.arguments.raw_only
    recorder = record(given.link, file, lambda: not ended, raw_only=raw_only, after_host=True)
    return FULL if recorder.recording.failure else 0


if __name__ == "__main__":
    sys.exit(main())
