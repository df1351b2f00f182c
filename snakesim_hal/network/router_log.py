"""A router's log, short and bounded: who was let in, and whom it refused what.

Zenoh tells whom it refuses at its most detailed level alone. There it also writes two lines for every message that it
lets pass, and lists what a session would not be allowed at a key as soon as the session mentions it. The name in a
certificate, and where a session comes from, are in lines of other levels. So Zenoh writes all of it into a pipe, and
what is worth reading goes to stderr: a line once, and how often it came again once a minute.
"""

import contextlib
import fcntl
import os
import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator

from snakesim_hal.terminal import complain

ZENOH_LEVELS = (
    "info,zenoh::net::routing::interceptor::access_control=trace,"
    "zenoh_link_tls::unicast=debug,zenoh_transport::unicast::establishment::accept=debug"
)
LOOK_S = 0.01  # between two looks into the pipe: Zenoh's threads wait while it is full
PIPE_BYTES = 1024 * 1024  # the most that Linux gives without privileges
AGAIN_S = 60.0
# A flood of different refusals must not fill a disk: some 20 MB a day.
BURST, PER_TURN = 10000, 100  # lines: at once, and in each `AGAIN_S`
MOST_CHARACTERS = 300  # of a line
SESSIONS_KEPT = 4000  # as many as a host of ours takes

COLOUR = re.compile(r"\x1b\[[0-9;]*m")
HEAD = re.compile(r"\S+Z +(?P<level>[A-Z]+) +(?:\S+ )?ThreadId\((?P<thread>\d+)\) (?P<module>[\w:]+): (?P<text>.*)")
ALLOWED, LISTS, ENDS_LIST = " is authorized to ", "caching permissions for", "Declare Liveliness Subscriber ("
REFUSED = re.compile(
    r"(?:Using cached result: )?(?P<session>[0-9a-f]+)(?: on (?P<subject>\S+))? is unauthorized to (?P<what>.*)"
)
IN_SUBJECT = re.compile(r"CertCommonName\((.*?)\)")
CERTIFIED = re.compile(r"Accepted TLS connection on .*?: (?P<address>\S+)\. Common Name: (?P<name>.*)\.")
NOBODY = re.compile(r"(?P<session>[0-9a-f]+) did not match any configured ACL subject")
LET_IN = re.compile(r"New transport link accepted from (?P<session>[0-9a-f]+) to .*? dst: \w+/(?P<address>[^ ,]+)")


class RouterLog:
    """Takes Zenoh's lines, tells the short ones."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell
        self._names: dict[str, str] = {}  # in certificates, by session, and until it is there by address
        self._nobodies: dict[str, str] = {}  # sessions that no rule names
        self._listing: set[str] = set()  # threads that list what would not be allowed
        self._again: Counter[str] = Counter()  # lines told in this turn: how often they came again
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
        """Call it every `AGAIN_S`: tells what came again, and begins anew."""
        again, left_out = self._again, self._left_out
        self._again, self._left_out, self._left = Counter(), 0, min(self._left + PER_TURN, BURST)
        for line, times in again.items():
            if times:
                self._say(f"{times} times more: {line}")
        if left_out or self._left_out:
            self._tell(f"{left_out + self._left_out} lines left out: more than {PER_TURN} different ones a minute")

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
        elif nobody := NOBODY.match(text):
            _keep(self._nobodies, nobody["session"], "")

    def _let_in(self, session: str, address: str) -> None:
        name = self._names.pop(address, f"session {session}")
        _keep(self._names, session, name)
        if self._nobodies.pop(session, None) is None:
            self._say(f"let in: {name} from {address}")
        else:
            self._say(f"refused: {name} from {address}: everything, because no rule is for it")

    def _say(self, line: str) -> None:
        line = line[:MOST_CHARACTERS]
        if line in self._again:
            self._again[line] += 1
        elif self._left <= 0:
            self._left_out += 1
        else:
            self._left -= 1
            self._again[line] = 0
            self._tell(line)


def _keep(kept: dict[str, str], key: str, value: str) -> None:
    """Store it as the newest, and forget the oldest of too many."""
    kept.pop(key, None)
    kept[key] = value
    while len(kept) > SESSIONS_KEPT:
        del kept[next(iter(kept))]


@contextlib.contextmanager
def short_log() -> Iterator[None]:
    """What Zenoh writes to stdout comes short to stderr, for as long as this lasts; what we print stays as it is."""
    log = RouterLog(lambda line: complain(f"{time.strftime('%Y-%m-%dT%H:%M:%SZ', time.gmtime())} {line}"))
    reading, writing = os.pipe()
    os.set_blocking(reading, False)
    with contextlib.suppress(PermissionError):  # somebody has too many pipes
        fcntl.fcntl(writing, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    reader = threading.Thread(target=_read, args=(reading, log), name="log", daemon=True)
    with open(os.dup(1), "w", buffering=1) as stdout:  # noqa: PTH123 - a descriptor
        os.dup2(writing, 1)
        os.close(writing)
        reader.start()
        try:
            with contextlib.redirect_stdout(stdout):
                yield
        finally:
            os.dup2(stdout.fileno(), 1)
            reader.join()
            log.turn()


def _read(pipe: int, log: RouterLog) -> None:
    """Until nobody can write into the pipe any more."""
    rest, turn_at_s = b"", time.monotonic() + AGAIN_S
    with os.fdopen(pipe, "rb", buffering=0) as source:
        while (got := source.read(PIPE_BYTES)) != b"":
            *lines, rest = (rest + (got or b"")).split(b"\n")
            for line in lines:
                log.take(line.decode(errors="replace"))
            if time.monotonic() >= turn_at_s:
                turn_at_s += AGAIN_S
                log.turn()
            time.sleep(LOOK_S)
