"""A router's log, short and bounded: who connected, and what was refused to whom.

Zenoh logs refusals only at its most detailed level, where it also writes two lines for each message that it forwards,
and lists all permissions of a session when that session first uses a key. The name in a certificate and the address of
a session are logged at other levels. So Zenoh logs everything into a pipe, and the relevant lines go to stderr: each
once, and once a minute how often it was repeated.
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
from snakesim_hal.base.workers import start_worker

ZENOH_LEVELS = (
    "info,zenoh::net::routing::interceptor::access_control=trace,"
    "zenoh_link_tls::unicast=debug,zenoh_transport::unicast::establishment::accept=debug"
)
LOOK_S = 0.01  # between two looks into the pipe: Zenoh's threads wait while it is full
PIPE_BYTES = 1024 * 1024  # the most that Linux gives without privileges
CLOSE_LIMIT_S = 2.0
AGAIN_S = 60.0
# A flood of different refusals must not fill a disk: some 20 MB a day.
BURST, PER_TURN = 10000, 100  # lines: at once, and in each `AGAIN_S`
MAX_LINE_CHARACTERS = 300  # of a line
SESSIONS_KEPT = 4000  # as many as a host of ours takes

COLOUR = re.compile(r"\x1b\[[0-9;]*m")
HEAD = re.compile(r"\S+Z +(?P<level>[A-Z]+) +(?:\S+ )?ThreadId\((?P<thread>\d+)\) (?P<module>[\w:]+): (?P<text>.*)")
ALLOWED, LISTS, ENDS_LIST = " is authorized to ", "caching permissions for", "Declare Liveliness Subscriber ("
REFUSED = re.compile(
    r"(?:Using cached result: )?(?P<session>[0-9a-f]+)(?: on (?P<subject>\S+))? is unauthorized to (?P<what>.*)"
)
IN_SUBJECT = re.compile(r"CertCommonName\((.*?)\)")
CERTIFIED = re.compile(r"Accepted TLS connection on .*?: (?P<address>\S+)\. Common Name: (?P<name>.*)\.")
UNMATCHED = re.compile(r"(?P<session>[0-9a-f]+) did not match any configured ACL subject")
LET_IN = re.compile(r"New transport link accepted from (?P<session>[0-9a-f]+) to .*? dst: \w+/(?P<address>[^ ,]+)")


class RouterLog:
    """Takes Zenoh's lines, and passes on the relevant ones."""

    def __init__(self, write: Callable[[str], None]) -> None:
        self._write = write
        self._names: dict[str, str] = {}  # in certificates, by session, and until it is there by address
        self._unmatched: dict[str, str] = {}  # sessions that no rule names
        self._listing: set[str] = set()  # threads that list what would not be allowed
        self._again: Counter[str] = Counter()  # lines of this turn -> number of repetitions
        self._left, self._left_out = BURST, 0

    def take(self, line: str) -> None:
        """One line of Zenoh's log."""
        if ALLOWED in line and ENDS_LIST not in line:
            return
        line = COLOUR.sub("", line)
        found = HEAD.fullmatch(line)
        if found is None:
            self._say(line)
        elif found["module"].endswith("access_control"):
            self._take_decision(found["thread"], found["text"])
        elif certified := CERTIFIED.fullmatch(found["text"]):
            _keep(self._names, certified["address"], certified["name"])
        elif let_in := LET_IN.match(found["text"]):
            self._let_in(let_in["session"], let_in["address"])
        elif found["level"] != "DEBUG":
            self._say(f"{found['level']} {found['module']}: {found['text']}")

    def turn(self) -> None:
        """Call it every `AGAIN_S`: reports repeated lines, and restarts the count."""
        again, left_out = self._again, self._left_out
        self._again, self._left_out, self._left = Counter(), 0, min(self._left + PER_TURN, BURST)
        for line, times in again.items():
            if times:
                self._say(f"{times} times more: {line}")
        if left_out or self._left_out:
            self._write(f"{left_out + self._left_out} lines left out: more than {PER_TURN} different ones a minute")

    def _take_decision(self, thread: str, text: str) -> None:
        refused = REFUSED.fullmatch(text)
        if LISTS in text:
            self._listing.add(thread)
        elif thread in self._listing:
            if ENDS_LIST in text:
                self._listing.discard(thread)
        elif refused is not None:
            named = IN_SUBJECT.search(refused["subject"] or "")
            who = named[1] if named else self._names.get(refused["session"], f"session {refused['session']}")
            self._say(f"refused: {who}: {refused['what']}")
        elif unmatched := UNMATCHED.match(text):
            _keep(self._unmatched, unmatched["session"], "")

    def _let_in(self, session: str, address: str) -> None:
        name = self._names.pop(address, f"session {session}")
        _keep(self._names, session, name)
        if self._unmatched.pop(session, None) is None:
            self._say(f"let in: {name} from {address}")
        else:
            self._say(f"refused: {name} from {address}: everything, because no rule is for it")

    def _say(self, line: str) -> None:
        line = line[:MAX_LINE_CHARACTERS]
        if line in self._again:
            self._again[line] += 1
        elif self._left <= 0:
            self._left_out += 1
        else:
            self._left -= 1
            self._again[line] = 0
            self._write(line)


def _keep(kept: dict[str, str], key: str, value: str) -> None:
    """Store it as the newest, and forget the oldest of too many."""
    kept.pop(key, None)
    kept[key] = value
    while len(kept) > SESSIONS_KEPT:
        del kept[next(iter(kept))]


@contextlib.contextmanager
def short_log() -> Iterator[None]:
    """While this lasts, Zenoh's output on stdout goes shortened to stderr; our own output is unchanged."""
    log = RouterLog(_to_stderr)
    reading, writing = os.pipe()
    os.set_blocking(reading, False)
    with contextlib.suppress(PermissionError):  # somebody has too many pipes
        fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    source = os.fdopen(reading, "rb", buffering=0)
    with open(os.dup(1), "w", buffering=1) as stdout:  # noqa: PTH123 - a descriptor
        os.dup2(writing, 1)
        os.close(writing)
        reader = start_worker("log", lambda: _read(source, log))
        try:
            with contextlib.redirect_stdout(stdout):
                yield
        finally:
            os.dup2(stdout.fileno(), 1)
            reader.join(CLOSE_LIMIT_S)
            if not reader.is_alive():
                source.close()
            log.turn()


def _to_stderr(line: str) -> None:
    """Drop the line when stderr is full: a router must not wait for the reader of its log."""
    with contextlib.suppress(OSError):
        if select.select([], [sys.stderr], [], 0.0)[1]:
            print_stderr(f"{time.strftime('%Y-%m-%dT%H:%M:%SZ', time.gmtime())} {line}")


def _read(source: RawIOBase, log: RouterLog) -> None:
    """Until the last writer has closed the pipe."""
    rest = b""
    turn_at_s = time.monotonic() + AGAIN_S
    while (got := source.read(PIPE_BYTES)) != b"":
        *lines, rest = (rest + (got or b"")).split(b"\n")
        for line in lines:
            log.take(line.decode(errors="replace"))
        if time.monotonic() >= turn_at_s:
            turn_at_s += AGAIN_S
            log.turn()
        time.sleep(LOOK_S)
