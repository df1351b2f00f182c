"""The recorder: a process of its own beside a run, or beside any robot. In real time, a robot never waits for it.

`python -m snakesim_operator.recording.recorder_process` is the child of `snakesim run`. `snakesim record` calls
`record_to_file`.

Data flow: Zenoh's threads -> `Tap` (bounded queue) -> `RobotRecorder`, in the main thread ->
`RecordingWriter` (one file).
"""

import argparse
import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from itertools import count
from pathlib import Path

from snakesim_hal.base.process import call_on_stop_signals, make_collections_rare

if __name__ == "__main__":
    make_collections_rare()

import msgspec

from snakesim_hal.base.errors import ConfigError, NotConnectedError, WireError
from snakesim_hal.base.terminal import print_stderr, run_tool
from snakesim_hal.model.fault_kinds import HAL
from snakesim_hal.network.process_entries import make_own_entry, publish_process_entry
from snakesim_hal.network.run_key import has_valid_proof, read_own_run_key
from snakesim_hal.network.session import ConnectionSettings, Session
from snakesim_hal.network.streams import IncomingQuery, ReceivedSample
from snakesim_hal.network.waiting import open_session_when_ready
from snakesim_hal.programs.arguments import (
    add_network_arguments,
    add_parent_argument,
    add_scenario_arguments,
)
from snakesim_hal.programs.service_program import ProcessOptions, read_process_options
from snakesim_hal.service import SERVICE_START_LIMIT_S
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import UNDECODABLE, MessageDecoder
from snakesim_hal.wire.messages import Answer, RobotDescription, TickDone
from snakesim_hal.wire.roles import RECORDER
from snakesim_operator.recording.foxglove_messages.file_writer import OnViewerMessage
from snakesim_operator.recording.log_clock import LogTimeClock
from snakesim_operator.recording.message import RAW_ONLY_HELP, RECORDING_FILENAME
from snakesim_operator.recording.tap import MessageTap
from snakesim_operator.recording.writer import RecordingWriter

CYCLE_S = 0.02
# At the end of a run, messages are on their way. If the host has not left, no more are expected after so many cycles
# without one: 2 s. Cycles and not seconds, because on a busy computer this process may pause for seconds.
QUIET_CYCLES_WITH_HOST = 100
# For messages that do not end: those of a host that stays, or of another program.
LAST_MESSAGES_LIMIT_S = 10.0
ROUND_TRIP_TIMEOUT_S = 2.0
NICENESS = 10  # a robot's own processes have precedence
MAX_HOSTS = 100  # files: one for each host that a robot had
EXIT_DISK_FULL = 4


class RobotRecorder:
    """Writes a robot's messages into a file, and starts a new file when the robot gets a new host."""

    def __init__(
        self,
        path: Path,
        viewer_robot_name: str | None,
        on_viewer_message: OnViewerMessage | None = None,
        log_time_clock: LogTimeClock = "robot",
    ) -> None:
        """Start the first file.

        Args:
            path: Path of the new file.
            viewer_robot_name: Name of the robot in topics for viewers. If None, only the robot's messages are recorded.
            on_viewer_message: Called with each message that is made for viewers. None if not needed.
            log_time_clock: Clock of the log times.

        Raises:
            OSError: The file cannot be created.
        """
        self.path = path
        self._viewer_robot_name = viewer_robot_name
        self._on_viewer_message = on_viewer_message
        self._log_time_clock: LogTimeClock = log_time_clock
        self._start_time = datetime.now(UTC)
        self.writer = RecordingWriter(path, viewer_robot_name, on_viewer_message, log_time_clock)

        # A new host publishes its description, and robot time starts over, in either order.
        # Newest messages that each file begins with, by key.
        self._latched_arrivals: dict[str, ReceivedSample] = {}
        self._host_id: str | None = None
        self._host_count = 1
        # A new host has described itself, and its file is not started yet.
        self._awaits_new_host_clock = False
        # Newest clock since robot time went back, until a file starts.
        self._restarted_clock: ReceivedSample | None = None

    def write_arrival(self, arrival: ReceivedSample) -> None:
        """Write one message. Once the description and the first clock of a new host have come, start a new file."""
        if arrival.key in (keys.DESCRIPTION, keys.CONFIG, keys.STATUS):
            self._latched_arrivals[arrival.key] = arrival
            if arrival.key == keys.DESCRIPTION:
                self._detect_new_host(arrival.payload)
        self.writer.write_arrival(arrival)
        if arrival.key == keys.CLOCK:
            has_restarted = (
                self._restarted_clock is not None or self.writer.message_clock.has_gone_back
            )
            if has_restarted:
                self._restarted_clock = arrival
        if self._awaits_new_host_clock and self._restarted_clock is not None:
            self._start_next_file(self._restarted_clock)

    def close(self, dropped_count_by_key: dict[str, int]) -> str:
        """Write metadata and index into the file, and close it.

        Args:
            dropped_count_by_key: Number of dropped messages by key, which the file then states.

        Returns:
            The reason why the file is incomplete; empty if it is complete.
        """
        metadata = {
            "version": version("snakesim"),
            "began": self._start_time.isoformat(),
            "dropped": dropped_count_by_key,
        }
        self.writer.close(metadata)
        return self.writer.failure

    def _detect_new_host(self, payload: bytes) -> None:
        """Compare the host in a description with the current host, and remember if it is a new one.

        A description whose origin cannot be verified is ignored.
        """
        with contextlib.suppress(*UNDECODABLE):
            robot = msgspec.msgpack.decode(payload, type=RobotDescription)
            if has_valid_proof(robot, read_own_run_key()):
                if self._host_id is not None and robot.host != self._host_id:
                    self._awaits_new_host_clock = True
                self._host_id = robot.host

    def _start_next_file(self, clock: ReceivedSample) -> None:
        """Complete the current file under another name, and start a new file after a change of the host.

        The new file begins with the latched messages and the clock. Beyond MAX_HOSTS files, nothing changes.

        Args:
            clock: The newest clock message of the new host.
        """
        self._awaits_new_host_clock = False
        self._restarted_clock = None
        if self._host_count >= MAX_HOSTS:
            return
        self._host_count += 1
        self.close({})
        self.path.rename(self._find_free_path())
        self.writer = RecordingWriter(
            self.path, self._viewer_robot_name, self._on_viewer_message, self._log_time_clock
        )
        for arrival in (*self._latched_arrivals.values(), clock):
            self.writer.write_arrival(arrival)

    def _find_free_path(self) -> Path:
        """Return the first path of NAME-1, NAME-2 and so on that does not exist."""
        numbers = count(1)
        while True:
            path = self.path.with_stem(f"{self.path.stem}-{next(numbers)}")
            if not path.exists():
                return path


def record_to_file(
    connection: ConnectionSettings,
    path: Path,
    should_continue: Callable[[], bool],
    on_viewer_message: OnViewerMessage | None = None,
    *,
    raw_only: bool = False,
    wait_for_host_exit: bool = False,
    log_time_clock: LogTimeClock = "robot",
) -> RobotRecorder:
    """Record a robot until the caller ends it or the disk is full.

    Args:
        connection: How to reach the robot.
        path: The new file.
        should_continue: Returns whether to continue; called in each cycle.
        on_viewer_message: Gets each message that is made for viewers.
        raw_only: Record messages as on the wire alone, without topics for viewers.
        wait_for_host_exit: At the end, wait until the robot's host has left the network.
        log_time_clock: The clock of the log times.

    Returns:
        The recorder with its closed file.

    Raises:
        ConfigError: The file exists or cannot be created.
        NotConnectedError: There was no network at the link until the end. No file is created.
    """
    with _connect_when_ready(connection, should_continue) as session:
        return _record_until_stopped(
            session,
            connection,
            path,
            should_continue,
            on_viewer_message,
            raw_only=raw_only,
            wait_for_host_exit=wait_for_host_exit,
            log_time_clock=log_time_clock,
        )


@contextlib.contextmanager
def _connect_when_ready(
    connection: ConnectionSettings, should_continue: Callable[[], bool] = lambda: True
) -> Iterator[Session]:
    """Connect as soon as the robot's network can be reached, and yield the session.

    Args:
        connection: How to reach the robot.
        should_continue: Returns whether to continue; called while the network is awaited.

    Raises:
        NotConnectedError: The network could not be reached in time, or until the recording was ended.
    """
    deadline_s = time.monotonic() + SERVICE_START_LIMIT_S
    is_stopped = False

    def should_keep_waiting() -> bool:
        nonlocal is_stopped
        is_stopped = not should_continue()
        return not is_stopped and time.monotonic() < deadline_s

    with contextlib.ExitStack() as stack:
        try:
            session = stack.enter_context(open_session_when_ready(connection, should_keep_waiting))
        except NotConnectedError as error:
            if not is_stopped:
                raise
            raise NotConnectedError(
                f"nothing listened on {connection.endpoint} until the recording was ended: nothing is recorded",
                code="network/nothing-listens",
            ) from error
        yield session


def _record_until_stopped(
    session: Session,
    connection: ConnectionSettings,
    path: Path,
    should_continue: Callable[[], bool],
    on_viewer_message: OnViewerMessage | None = None,
    *,
    raw_only: bool,
    wait_for_host_exit: bool,
    log_time_clock: LogTimeClock = "robot",
) -> RobotRecorder:
    """Record the messages of a robot over a session that is open, until the caller ends it or the disk is full.

    Args:
        session: Session on the robot's network.
        connection: How to reach the robot, with its namespace.
        path: The new file.
        should_continue: Called in every cycle; returns whether to continue.
        on_viewer_message: Gets each message that is made for viewers.
        raw_only: Whether to record only the messages as on the wire, without those for viewers.
        wait_for_host_exit: Whether to record until the host's last messages have arrived.
        log_time_clock: The clock of the log times.

    Returns:
        The recorder, whose file is closed.

    Raises:
        ConfigError: The file cannot be created.
    """
    viewer_robot_name = None
    if not raw_only:
        viewer_robot_name = connection.namespace or "robot"
    try:
        recorder = RobotRecorder(path, viewer_robot_name, on_viewer_message, log_time_clock)
    except OSError as error:
        raise ConfigError(
            f"{path}: {error.strerror}; choose another file", code="file/not-writable"
        ) from error
    tap = MessageTap(session)
    present_hosts = _track_present_hosts(session)
    session.on_query(keys.RECEIVED, partial(_confirm_receipt, MessageDecoder(TickDone)))
    session.declare_alive(RECORDER)
    publish_process_entry(session, make_own_entry(RECORDER))
    while should_continue() and not recorder.writer.failure:
        _write_arrivals(tap, recorder)
        time.sleep(CYCLE_S)
    if wait_for_host_exit:
        _write_last_messages(session, tap, recorder, present_hosts)
    _write_arrivals(tap, recorder)
    for key, dropped_count in sorted(tap.dropped_count_by_key.items()):
        print_stderr(f"{dropped_count} messages on {key} were dropped: the disk was too slow")
    failure = recorder.close(dict(tap.dropped_count_by_key))
    if failure:
        print_stderr(f"recording ended: {failure}")
    return recorder


def _confirm_receipt(decoder: MessageDecoder[TickDone], query: IncomingQuery) -> None:
    """Answer a host that has ended its run, and waits until its messages have arrived.

    Zenoh's thread calls this after all earlier messages of the host, so that the tap has them.

    Args:
        decoder: Decoder of the query's payload, the last tick of the host.
        query: The query. It is refused if its payload cannot be decoded.
    """
    try:
        decoder.decode(query.payload, query.encoding)
    except WireError as error:
        query.reply(Answer(ok=False, reason=str(error), refusal=error.reason))
    else:
        query.reply(Answer(ok=True, reason="all messages have arrived"))


def _track_present_hosts(session: Session) -> set[str]:
    """Return a set that is updated, from now on, with the liveliness keys of the hosts on the network."""
    hosts: set[str] = set()

    def update(key: str, is_present: bool) -> None:
        if is_present:
            hosts.add(key)
        else:
            hosts.discard(key)

    session.on_token_change(update, keys.alive_key(HAL))
    return hosts


def _write_last_messages(
    session: Session, tap: MessageTap, recorder: RobotRecorder, present_hosts: set[str]
) -> None:
    """Write the last messages of a run, until the host has left and no message is on its way.

    In a run the recorder ends last, so messages of the other processes may still be queued in the network. In lockstep,
    a host leaves only after `_confirm_receipt`. Otherwise its last messages may be queued in a router, which answers
    this session after them, on the same connection. So once the router has answered, none of them is on its way.

    Args:
        session: Session on the robot's network.
        tap: Has the messages that have arrived.
        recorder: Writes the messages.
        present_hosts: Liveliness keys of the hosts on the network; other threads update the set.
    """
    limit_s = time.monotonic() + LAST_MESSAGES_LIMIT_S
    quiet_cycles = 0
    while time.monotonic() < limit_s:
        has_left = not present_hosts
        if has_left:
            session.list_tokens(keys.alive_key(HAL), ROUND_TRIP_TIMEOUT_S)
        if _write_arrivals(tap, recorder) > 0:
            quiet_cycles = 0
        elif has_left:
            return
        else:
            quiet_cycles += 1
        if quiet_cycles >= QUIET_CYCLES_WITH_HOST:
            return
        time.sleep(CYCLE_S)


def _write_arrivals(tap: MessageTap, recorder: RobotRecorder) -> int:
    """Write the messages that have arrived since the last call, and return their number.

    In lockstep, as the newest clock states it, the tap is made lossless until it has dropped a message.
    """
    arrivals = tap.take_arrivals()
    for arrival in arrivals:
        recorder.write_arrival(arrival)
    clock = recorder.writer.message_clock.newest_clock
    if clock is not None and not tap.dropped_count_by_key:
        tap.is_lossless = clock.clock_mode == "lockstep"
    recorder.writer.flush_when_due()
    return len(arrivals)


def main(argv: Sequence[str] | None = None) -> int:
    """Record a run into its folder until a stop signal.

    Returns:
        The exit code: 0; 2 for wrong input; EXIT_DISK_FULL; 1 for any other failure.
    """
    parser = argparse.ArgumentParser(description="Record a run.")
    parser.add_argument("--out", type=Path, default=Path(), help="folder of the run")
    parser.add_argument("--raw-only", action="store_true", help=RAW_ONLY_HELP)
    add_scenario_arguments(parser)
    add_network_arguments(parser, "")
    add_parent_argument(parser)
    arguments = parser.parse_args(argv)
    return run_tool(
        f"snakesim {RECORDER}",
        lambda: _record_run_until_stop_signal(read_process_options(arguments)),
    )


def _record_run_until_stop_signal(options: ProcessOptions) -> int:
    """Record as a child process of a run, with a low priority, until a stop signal. Return the exit code.

    Until it is connected, a stop signal ends the process at once: there is no file to close yet, and the network of a
    run that has ended never opens.
    """
    os.nice(NICENESS)
    # A batch process: its threads are woken by each message, and must not displace the robot's processes.
    os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
    path = options.arguments.out / RECORDING_FILENAME
    raw_only = options.arguments.raw_only
    with _connect_when_ready(options.link) as session:
        stop_signals: list[bool] = []
        call_on_stop_signals(lambda: stop_signals.append(True))
        recorder = _record_until_stopped(
            session,
            options.link,
            path,
            lambda: not stop_signals,
            raw_only=raw_only,
            wait_for_host_exit=True,
        )
    if recorder.writer.failure:
        return EXIT_DISK_FULL
    return 0


if __name__ == "__main__":
    sys.exit(main())
