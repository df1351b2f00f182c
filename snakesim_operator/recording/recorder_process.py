"""The recorder: a process of its own beside a run, or beside any robot. In real time, a robot never waits for it.

`python -m snakesim_operator.recording.recorder_process` is the child of `snakesim run`. `snakesim record` calls
`record_to_file`.

Data flow: Zenoh's threads -> `Tap` (bounded queue) -> `Recorder`, in the main thread -> `RecordingWriter` (one file).
"""

import argparse
import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import count
from pathlib import Path

import msgspec

from snakesim_hal.base.errors import ConfigError, NotConnectedError
from snakesim_hal.base.process import on_stop_signal
from snakesim_hal.base.terminal import print_stderr, run_tool
from snakesim_hal.model.fault_kinds import HAL
from snakesim_hal.network.process_entries import own_entry, show_process
from snakesim_hal.network.run_key import is_proven, own_run_key
from snakesim_hal.network.session import Link, Session
from snakesim_hal.network.streams import Arrival
from snakesim_hal.network.waiting import open_session_when_ready
from snakesim_hal.programs.arguments import add_network, add_parent, add_scenario
from snakesim_hal.programs.service_program import ProcessOptions, process_options
from snakesim_hal.service import SERVICE_START_LIMIT_S
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import Description
from snakesim_hal.wire.roles import RECORDER
from snakesim_operator.recording.message import RAW_ONLY, RECORDING
from snakesim_operator.recording.tap import Tap
from snakesim_operator.recording.writer import RecordingWriter, Show

CYCLE_S = 0.02
LAST_MESSAGES_TIMEOUT_S = 2.0  # at the end, for messages that are on their way
QUIET_CYCLES = 2  # at the end: after so many cycles without a message, none is on its way
NICE = 10  # a robot's own processes have precedence
MAX_HOSTS = 100  # files: one for each host that a robot had
EXIT_DISK_FULL = 4


class Recorder:
    """Writes a robot's messages into a file, and begins a new file when the robot gets a new host."""

    def __init__(self, path: Path, shown_as: str | None, show: Show | None = None) -> None:
        """Begin the first file. The arguments are those of Recording. Raises OSError if it cannot be created."""
        self.path = path
        self._shown_as = shown_as
        self._show = show
        self._began = datetime.now(UTC)
        self.recording = RecordingWriter(path, shown_as, show)

        # What a new host changes: its description comes, and robot time starts over, in either order.
        self._latched: dict[str, Arrival] = {}  # newest messages that each file begins with, by key
        self._host: str | None = None
        self._host_count = 1
        self._host_is_new = False  # and has no file
        self._restarted_clock: Arrival | None = None  # the newest clock, if time went back and has no file

    def write(self, arrival: Arrival) -> None:
        """Write one message. Once the description and the first clock of a new host have come, begin a new file."""
        if arrival.key in (keys.DESCRIPTION, keys.CONFIG, keys.STATUS):
            self._latched[arrival.key] = arrival
            if arrival.key == keys.DESCRIPTION:
                self._read_host(arrival.payload)
        self.recording.write_arrival(arrival)
        if arrival.key == keys.CLOCK:
            has_restarted = self._restarted_clock is not None or self.recording.time.went_back
            if has_restarted:
                self._restarted_clock = arrival
        if self._host_is_new and self._restarted_clock is not None:
            self._begin_next_file(self._restarted_clock)

    def close(self, dropped: dict[str, int]) -> str:
        """Write metadata and index into the file, and close it.

        Args:
            dropped: Number of dropped messages by key, which the file then states.

        Returns:
            Why the file is incomplete, or an empty text.
        """
        about = {
            "version": version("snakesim"),
            "began": self._began.isoformat(),
            "dropped": dropped,
        }
        self.recording.close(about)
        return self.recording.failure

    def _read_host(self, payload: bytes) -> None:
        """Note whether a description comes from a new host; an unproven one is ignored."""
        with contextlib.suppress(*UNDECODABLE):
            robot = msgspec.msgpack.decode(payload, type=Description)
            if is_proven(robot, own_run_key()):
                if self._host is not None and robot.host != self._host:
                    self._host_is_new = True
                self._host = robot.host

    def _begin_next_file(self, clock: Arrival) -> None:
        """Keep what was written under another name, and begin a new file with the latched messages and a clock."""
        self._host_is_new = False
        self._restarted_clock = None
        if self._host_count >= MAX_HOSTS:
            return
        self._host_count += 1
        self.close({})
        self.path.rename(self._find_free_path())
        self.recording = RecordingWriter(self.path, self._shown_as, self._show)
        for arrival in (*self._latched.values(), clock):
            self.recording.write_arrival(arrival)

    def _find_free_path(self) -> Path:
        """Return the first of NAME-1, NAME-2 and so on that does not exist."""
        numbers = count(1)
        while True:
            path = self.path.with_stem(f"{self.path.stem}-{next(numbers)}")
            if not path.exists():
                return path


def record_to_file(
    link: Link,
    path: Path,
    goes_on: Callable[[], bool],
    show: Show | None = None,
    *,
    raw_only: bool = False,
    after_host: bool = False,
) -> Recorder:
    """Record a robot until the caller ends it or the disk is full.

    Args:
        link: How to reach the robot.
        path: The new file.
        goes_on: Returns whether to continue; called in each cycle.
        show: Gets each message that is made for viewers.
        raw_only: Record messages as on the wire alone, without topics for viewers.
        after_host: At the end, wait until the robot's host has left the network.

    Returns:
        The recorder with its closed file.

    Raises:
        ConfigError: The file exists or cannot be created.
        NotConnectedError: There was no network at the link until the end. No file is created.
    """
    with _connect(link, goes_on) as session:
        return _record_session(session, link, path, goes_on, show, raw_only=raw_only, after_host=after_host)


@contextlib.contextmanager
def _connect(link: Link, goes_on: Callable[[], bool] = lambda: True) -> Iterator[Session]:
    """Connect as soon as there is a network, unless the recording ends before."""
    give_up_s = time.monotonic() + SERVICE_START_LIMIT_S
    is_stopped = False

    def keeps_waiting() -> bool:
        nonlocal is_stopped
        is_stopped = not goes_on()
        return not is_stopped and time.monotonic() < give_up_s

    with contextlib.ExitStack() as stack:
        try:
            session = stack.enter_context(open_session_when_ready(link, keeps_waiting))
        except NotConnectedError as error:
            if not is_stopped:
                raise
            raise NotConnectedError(
                f"nothing listened on {link.endpoint} until the recording was ended: nothing is recorded",
                code="network/nothing-listens",
            ) from error
        yield session


def _record_session(
    session: Session,
    link: Link,
    path: Path,
    goes_on: Callable[[], bool],
    show: Show | None = None,
    *,
    raw_only: bool,
    after_host: bool,
) -> Recorder:
    """Record over a session that is open. The arguments are those of `record_to_file`."""
    shown_as = None
    if not raw_only:
        shown_as = link.namespace or "robot"
    try:
        recorder = Recorder(path, shown_as, show)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}; choose another file", code="file/not-writable") from error
    tap = Tap(session)
    hosts = _watch_hosts(session)
    session.declare_alive(RECORDER)
    show_process(session, own_entry(RECORDER))
    while goes_on() and not recorder.recording.failure:
        _write_arrivals(tap, recorder)
        time.sleep(CYCLE_S)
    if after_host:
        _write_last_messages(tap, recorder, hosts)
    _write_arrivals(tap, recorder)
    for key, number in sorted(tap.dropped.items()):
        print_stderr(f"{number} messages on {key} were dropped: the disk was too slow")
    failure = recorder.close(dict(tap.dropped))
    if failure:
        print_stderr(f"recording ended: {failure}")
    return recorder


def _watch_hosts(session: Session) -> set[str]:
    """Return a set that holds the liveliness keys of the hosts that are present, from now on."""
    hosts: set[str] = set()

    def update(key: str, is_present: bool) -> None:
        if is_present:
            hosts.add(key)
        else:
            hosts.discard(key)

    session.on_alive(update, keys.alive_key(HAL))
    return hosts


def _write_last_messages(tap: Tap, recorder: Recorder, hosts: set[str]) -> None:
    """Write what an ending host still sends, until it has left and no message is on its way.

    In a run the recorder ends last, so messages of the others may wait in the network.
    """
    give_up_s = time.monotonic() + LAST_MESSAGES_TIMEOUT_S
    quiet_cycles = 0
    while quiet_cycles < QUIET_CYCLES and time.monotonic() < give_up_s:
        arrival_count = _write_arrivals(tap, recorder)
        if arrival_count > 0 or hosts:
            quiet_cycles = 0
        else:
            quiet_cycles += 1
        time.sleep(CYCLE_S)


def _write_arrivals(tap: Tap, recorder: Recorder) -> int:
    """Write what has arrived since the last call, and return the number of messages."""
    arrivals = tap.drain()
    for arrival in arrivals:
        recorder.write(arrival)
    clock = recorder.recording.time.clock
    if clock is not None and not tap.dropped:
        tap.lossless = clock.clock_mode == "lockstep"
    recorder.recording.flush_when_due()
    return len(arrivals)


def main(argv: Sequence[str] | None = None) -> int:
    """Record a run into its folder until a stop signal.

    Returns:
        The exit code: 0; 2 for wrong input; EXIT_DISK_FULL; 1 for any other failure.
    """
    parser = argparse.ArgumentParser(description="Record a run.")
    parser.add_argument("--out", type=Path, default=Path(), help="folder of the run")
    parser.add_argument("--raw-only", action="store_true", help=RAW_ONLY)
    add_scenario(parser)
    add_network(parser, "")
    add_parent(parser)
    arguments = parser.parse_args(argv)
    return run_tool(f"snakesim {RECORDER}", lambda: _record_run(process_options(arguments)))


def _record_run(options: ProcessOptions) -> int:
    """Record as a child process of a run, with a low priority.

    Until it is connected, a stop signal ends the process at once: it has no file that it would have to close, and the
    network of a run that has ended never opens.
    """
    os.nice(NICE)
    # A batch process: its threads are woken by each message, and must not displace the robot's processes.
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    path = options.arguments.out / RECORDING
    raw_only = options.arguments.raw_only
    with _connect(options.link) as session:
        stop_signals: list[bool] = []
        on_stop_signal(lambda: stop_signals.append(True))
        recorder = _record_session(
            session, options.link, path, lambda: not stop_signals, raw_only=raw_only, after_host=True
        )
    if recorder.recording.failure:
        return EXIT_DISK_FULL
    return 0


if __name__ == "__main__":
    sys.exit(main())
