"""A router's log, short and bounded: who connected, and what was refused to whom.

Zenoh logs refusals only at its most detailed level, where it also writes two lines for each message that it forwards,
and lists all permissions of a session when that session first uses a key. The name in a certificate and the address of
a session are logged at other levels. So Zenoh logs everything into a pipe, and the relevant lines go to stderr: each
once, and once a minute how often it was repeated.

Threads: the thread `log` reads the pipe and makes every call of `RouterLog`; after it has ended, the main thread makes
the last one.
"""

import contextlib
import fcntl
import os
import re
import select
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from io import RawIOBase

from snakesim_hal.base.terminal import print_stderr
from snakesim_hal.base.workers import start_restarting_thread

ZENOH_LEVELS = (
    "info,zenoh::net::routing::interceptor::access_control=trace,"
    "zenoh_link_tls::unicast=debug,zenoh_transport::unicast::establishment::accept=debug"
)
POLL_S = 0.01  # between two looks into the pipe: Zenoh's threads wait while it is full
PIPE_BYTES = 1024 * 1024  # the maximum that Linux gives without privileges
CLOSE_TIMEOUT_S = 2.0
REPORT_INTERVAL_S = 60.0  # between two reports of repeated lines
# A flood of different refusals must not fill a disk: some 20 MB a day.
MAX_BURST_LINES = 10000  # at once
LINES_PER_INTERVAL = 100  # in each REPORT_INTERVAL_S
MAX_LINE_CHARACTERS = 300
MAX_SESSIONS = 4000  # whose names are stored, as many as a host accepts

COLOR_CODE = re.compile(r"\x1b\[[0-9;]*m")
LOG_LINE = re.compile(
    r"\S+Z +(?P<level>[A-Z]+) +(?:\S+ )?ThreadId\((?P<thread>\d+)\) (?P<module>[\w:]+): (?P<text>.*)"
)
ALLOWED_MARKER = " is authorized to "
LIST_START_MARKER = "caching permissions for"
LIST_END_MARKER = "Declare Liveliness Subscriber ("
REFUSAL = re.compile(
    r"(?:Using cached result: )?(?P<session>[0-9a-f]+)(?: on (?P<subject>\S+))? is unauthorized to (?P<what>.*)"
)
CERTIFICATE_NAME = re.compile(r"CertCommonName\((.*?)\)")
TLS_CONNECTION = re.compile(
    r"Accepted TLS connection on .*?: (?P<address>\S+)\. Common Name: (?P<name>.*)\."
)
UNMATCHED_SESSION = re.compile(r"(?P<session>[0-9a-f]+) did not match any configured ACL subject")
NEW_CONNECTION = re.compile(
    r"New transport link accepted from (?P<session>[0-9a-f]+) to .*? dst: \w+/(?P<address>[^ ,]+)"
)


class RouterLog:
    """Reads the lines of Zenoh's log, and writes the relevant ones, shortened."""

    def __init__(self, write: Callable[[str], None]) -> None:
        """Write each relevant line with `write`."""
        self._write = write
        # Sessions.
        # Names in certificates, by session, or by address until the session is known.
        self._names: dict[str, str] = {}
        self._unmatched: dict[str, str] = {}  # ids of sessions that no rule names, as keys
        # Threads of Zenoh that are listing all permissions of a session.
        self._listing_threads: set[str] = set()
        # Written lines.
        self._repetition_counts: Counter[str] = Counter()  # by line, since the last report
        self._remaining_line_count = MAX_BURST_LINES  # how many lines may still be written
        self._dropped_line_count = 0  # lines since the last report

    def process_line(self, line: str) -> None:
        """Write one line of Zenoh's log in a short form if it is relevant, and store the name in a certificate.

        Lines about granted permissions are dropped. A line that does not look like one of Zenoh is written as it is.

        Args:
            line: Line without its line end.
        """
        is_granted_permission = ALLOWED_MARKER in line and LIST_END_MARKER not in line
        if is_granted_permission:
            return
        line = COLOR_CODE.sub("", line)
        parts = LOG_LINE.fullmatch(line)
        if parts is None:
            self._write_once(line)
            return
        text = parts["text"]
        if parts["module"].endswith("access_control"):
            self._process_access_decision(parts["thread"], text)
            return
        certificate = TLS_CONNECTION.fullmatch(text)
        if certificate is not None:
            _store_newest(self._names, certificate["address"], certificate["name"])
            return
        connection = NEW_CONNECTION.match(text)
        if connection is not None:
            self._report_connection(connection["session"], connection["address"])
        elif parts["level"] != "DEBUG":
            self._write_once(f"{parts['level']} {parts['module']}: {text}")

    def report_repetitions(self) -> None:
        """Report repeated and dropped lines, and restart the count. Call it every REPORT_INTERVAL_S."""
        repetitions = self._repetition_counts
        dropped = self._dropped_line_count
        self._repetition_counts = Counter()
        self._dropped_line_count = 0
        self._remaining_line_count = min(
            self._remaining_line_count + LINES_PER_INTERVAL, MAX_BURST_LINES
        )
        for line, times in repetitions.items():
            if times:
                self._write_once(f"{times} times more: {line}")
        dropped += self._dropped_line_count  # the reports themselves may have been dropped
        if dropped:
            self._write(
                f"{dropped} lines left out: more than {LINES_PER_INTERVAL} different ones a minute"
            )

    def _process_access_decision(self, thread: str, text: str) -> None:
        """Process a line of the access control: write a refusal, skip a list, or store a session that no rule names."""
        if LIST_START_MARKER in text:
            self._listing_threads.add(thread)
            return
        if thread in self._listing_threads:
            if LIST_END_MARKER in text:
                self._listing_threads.discard(thread)
            return
        refusal = REFUSAL.fullmatch(text)
        if refusal is not None:
            name = self._find_name(refusal["session"], refusal["subject"] or "")
            self._write_once(f"refused: {name}: {refusal['what']}")
            return
        unmatched = UNMATCHED_SESSION.match(text)
        if unmatched is not None:
            _store_newest(self._unmatched, unmatched["session"], "")

    def _find_name(self, session: str, subject: str) -> str:
        """Return the name in a session's certificate, or the session's id if it is not known."""
        named = CERTIFICATE_NAME.search(subject)
        if named:
            return named[1]
        return self._names.get(session, f"session {session}")

    def _report_connection(self, session: str, address: str) -> None:
        """Report a new connection. Its name is known by address until now, and by session from now on."""
        name = self._names.pop(address, f"session {session}")
        _store_newest(self._names, session, name)
        if self._unmatched.pop(session, None) is None:
            self._write_once(f"let in: {name} from {address}")
        else:
            self._write_once(
                f"refused: {name} from {address}: everything, because no rule is for it"
            )

    def _write_once(self, line: str) -> None:
        """Write a line, unless it was written since the last report or there are too many lines."""
        line = line[:MAX_LINE_CHARACTERS]
        if line in self._repetition_counts:
            self._repetition_counts[line] += 1
        elif self._remaining_line_count <= 0:
            self._dropped_line_count += 1
        else:
            self._remaining_line_count -= 1
            self._repetition_counts[line] = 0
            self._write(line)


def _store_newest(entries: dict[str, str], key: str, value: str) -> None:
    """Store a value as the newest one, and drop the oldest values if there are more than MAX_SESSIONS."""
    entries.pop(key, None)
    entries[key] = value
    while len(entries) > MAX_SESSIONS:
        del entries[next(iter(entries))]


@contextlib.contextmanager
def shortened_zenoh_log() -> Iterator[None]:
    """Write a short form of Zenoh's log to stderr while the context lasts.

    Zenoh writes its log to the file descriptor of stdout. The descriptor is replaced by a pipe, and a thread reads the
    pipe. `sys.stdout` is redirected to a copy of the original descriptor, so that Python's output is unchanged.
    """
    log = RouterLog(_write_to_stderr)
    read_end, write_end = os.pipe()
    os.set_blocking(read_end, False)
    with contextlib.suppress(PermissionError):  # the pipes of this user are too large already
        fcntl.fcntl(write_end, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    source = os.fdopen(read_end, "rb", buffering=0)
    with open(os.dup(1), "w", buffering=1) as stdout:  # noqa: PTH123 - a descriptor
        os.dup2(write_end, 1)
        os.close(write_end)
        reader = start_restarting_thread("log", lambda: _read_pipe(source, log))
        try:
            with contextlib.redirect_stdout(stdout):
                yield
        finally:
            os.dup2(stdout.fileno(), 1)
            reader.join(CLOSE_TIMEOUT_S)
            if not reader.is_alive():
                source.close()
            log.report_repetitions()


def _write_to_stderr(line: str) -> None:
    """Write a line with a timestamp to stderr. It is dropped if stderr is full: a router must not wait for a reader."""
    with contextlib.suppress(OSError):
        if select.select([], [sys.stderr], [], 0.0)[1]:
            print_stderr(f"{time.strftime('%Y-%m-%dT%H:%M:%SZ', time.gmtime())} {line}")


def _read_pipe(source: RawIOBase, log: RouterLog) -> None:
    """Pass lines to the log until the last writer has closed the pipe, in the thread `log`."""
    unfinished = b""  # the begin of a line
    next_report_s = time.monotonic() + REPORT_INTERVAL_S
    while (data := source.read(PIPE_BYTES)) != b"":  # None: the pipe is empty now
        *lines, unfinished = (unfinished + (data or b"")).split(b"\n")
        for line in lines:
            log.process_line(line.decode(errors="replace"))
        if time.monotonic() >= next_report_s:
            next_report_s += REPORT_INTERVAL_S
            log.report_repetitions()
        time.sleep(POLL_S)
