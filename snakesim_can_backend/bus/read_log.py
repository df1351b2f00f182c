"""Read a log of a CAN bus: every frame that is whole, and which lines are not.

`.log` is what candump writes: `candump -L`, as the driver's own log is, or what it prints on a terminal, with any of
its times or none. `.asc` and `.blf` are read by python-can. A log that ends in the middle of a line, as after a power
loss, gives all frames before it.
"""

import gzip
import math
import re
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass
from datetime import datetime
from itertools import islice, pairwise
from pathlib import Path
from typing import BinaryIO

import can

from snakesim_hal.base.errors import ConfigError

KINDS = ".log, .asc, .blf"
NAMED = 3  # dropped lines that are named; the others are counted
SHOWN = 60  # characters of a dropped line
LOOKED_AT = 500  # lines, to know whether their times are differences
STEP_S = 1e-6  # between frames of a log without times
ERROR_FLAG, EXTENDED_FLAG_DIGITS = 0x20000000, 8
ID_BITS = 0x1FFFFFFF
FAST_DATA = 1  # of the flags of CAN FD: the data had a second bit rate

COMPACT = re.compile(  # (1700000000.000000) can0 105#00112233 R
    r"\((?P<time>\d+\.\d+)\)\s+(?P<channel>\S+)\s+(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})"
    r"#(?:(?P<remote>R\d?)|(?P<flags>#[0-9A-Fa-f])?(?P<data>(?:[0-9A-Fa-f]{2})*)(?:_[0-9A-F])?)"
    r"(?:\s+(?P<direction>[RT]))?\s*"
)
PRINTED = re.compile(  # can0  105   [8]  00 11 22 33 44 55 66 77; of CAN FD the length has two digits
    r"\s*(?:\((?P<time>[^)]+)\)\s+)?(?P<channel>\S+)\s+(?:(?P<direction>[RT])X\s+\S+\s+\S+\s+)?"
    r"(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})\s+\[(?P<length>\d{1,2})\](?P<rest>.*)"
)
BYTE = re.compile(r"\s+([0-9A-Fa-f]{2})(?=\s|$)")


@dataclass(frozen=True)
class DroppedLine:
    """A line, or the rest of a file, that is no whole frame."""

    where: str  # such as "line 17"
    text: str

    def __str__(self) -> str:
        return f"{self.where}: {self.text}"


class BusLog:
    """A log, read frame by frame. What was dropped is known when all frames were read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.dropped: list[DroppedLine] = []  # the first ones
        self.dropped_count = 0
        self.has_times = True

    def __iter__(self) -> Iterator[can.Message]:
        """Every whole frame. Raises ConfigError for a file without any, if it is not empty."""
        frames = 0
        read = self._read_candump if self._is_candump() else self._read_by_python_can
        for message in read():
            frames += 1
            yield message
        if frames == 0 and self.dropped:
            raise self._refusal(str(self.dropped[0]))

    def report(self) -> Iterator[str]:
        """Yield lines for a person: what was left out, and what is not known of the rest."""
        if self.dropped_count:
            named = "; ".join(map(str, self.dropped))
            unnamed = self.dropped_count - len(self.dropped)
            more = f"; and {unnamed} more" if unnamed else ""
            lines = "1 line is no whole frame and was"
            if self.dropped_count > 1:
                lines = f"{self.dropped_count} lines are no whole frames and were"
            yield f"{lines} left out: {named}{more}"
        if not self.has_times:
            yield "the frames have no times (candump -t a has): an answer counts as in time until the next Sync"

    # --- candump ------------------------------------------------------------------------------------------------

    def _is_candump(self) -> bool:
        suffixes = [suffix.lower() for suffix in self.path.suffixes]
        return suffixes[-1:] == [".log"] or suffixes[-2:] == [".log", ".gz"]

    def _read_candump(self) -> Iterator[can.Message]:
        times_are_steps = self._times_are_steps()
        time_s = 0.0
        for number, line in self._lines():
            if not line.strip():
                continue
            message = parse_line(line)
            if message is None:
                self._drop(f"line {number}", line)
                continue
            if not message.timestamp:
                message.timestamp = time_s + STEP_S
            elif times_are_steps:
                message.timestamp += time_s
            time_s = message.timestamp
            yield message

    def _times_are_steps(self) -> bool:
        """Whether times are since the frame before, as `candump -t d` prints them: they go back now and then."""
        read = (parse_line(line) for _, line in islice(self._lines(), LOOKED_AT))
        times = [message.timestamp for message in read if message is not None]
        self.has_times = not times or any(times)
        return any(after < before for before, after in pairwise(times))

    def _lines(self) -> Iterator[tuple[int, str]]:
        number = 0
        try:
            with closing(self._open()) as file:
                for number, line in enumerate(file, start=1):
                    yield number, line.decode("utf-8", errors="replace")
        except OSError as error:
            raise self._refusal(error.strerror or str(error)) from None
        except EOFError as error:  # a compressed file that was cut
            self._drop(f"after line {number}", str(error))

    def _open(self) -> gzip.GzipFile | BinaryIO:
        if self.path.suffix.lower() == ".gz":
            return gzip.open(self.path, "rb")
        return self.path.open("rb")

    # --- other files --------------------------------------------------------------------------------------------

    def _read_by_python_can(self) -> Iterator[can.Message]:
        frames = 0
        try:
            with can.LogReader(self.path) as log:
                for message in log:
                    frames += 1
                    yield message
        except Exception as error:  # noqa: BLE001 - a damaged file makes python-can's readers raise almost anything
            if frames == 0:
                raise self._refusal(str(error)[:200]) from None
            self._drop(f"after frame {frames}", str(error) or type(error).__name__)

    # --- inside -------------------------------------------------------------------------------------------------

    def _drop(self, where: str, text: str) -> None:
        self.dropped_count += 1
        if len(self.dropped) < NAMED:
            shown = repr(text.rstrip("\r\n"))
            self.dropped.append(DroppedLine(where, shown if len(shown) <= SHOWN else f"{shown[:SHOWN]}..."))

    def _refusal(self, why: str) -> ConfigError:
        return ConfigError(f"{self.path} cannot be read as a log of a CAN bus ({KINDS}): {why}")


def parse_line(line: str) -> can.Message | None:
    """Return the frame of a line of candump; None if it is not whole. A time of 0: the line has none."""
    whole = line.endswith("\n")
    if found := COMPACT.fullmatch(line):
        # A line without its end may have lost bytes; the direction comes after them.
        return _compact(found) if whole or found["direction"] else None
    if found := PRINTED.fullmatch(line.rstrip("\r\n")):
        return _printed(found)
    return None


def _compact(found: re.Match[str]) -> can.Message:
    data = bytes.fromhex(found["data"] or "")
    return _message(
        found,
        float(found["time"]),
        data,
        is_fd=found["flags"] is not None,
        has_fast_data=found["flags"] is not None and bool(int(found["flags"][1:], 16) & FAST_DATA),
        is_remote=found["remote"] is not None,
        length=int(found["remote"][1:] or 0) if found["remote"] else len(data),
    )


def _printed(found: re.Match[str]) -> can.Message | None:
    length, rest = int(found["length"]), found["rest"]
    is_remote = rest.strip().startswith("remote request")
    data = bytes.fromhex("".join(BYTE.findall(rest)[:length]))
    time_s = _time_s(found["time"])
    if time_s is None or (len(data) < length and not is_remote):
        return None
    return _message(found, time_s, data, is_fd=len(found["length"]) > 1, is_remote=is_remote, length=length)


def _time_s(text: str | None) -> float | None:
    """Return a time as candump prints it: seconds, or a date; 0: there is none. None: it is none of these."""
    if text is None:
        return 0.0
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if math.isfinite(seconds):
        return seconds
    try:
        return datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError):
        return None


def _message(
    found: re.Match[str],
    time_s: float,
    data: bytes,
    *,
    is_fd: bool,
    is_remote: bool,
    length: int,
    has_fast_data: bool = False,
) -> can.Message:
    number = int(found["id"], 16)
    is_extended = len(found["id"]) == EXTENDED_FLAG_DIGITS
    if is_extended and number & ERROR_FLAG:
        return can.Message(timestamp=time_s, channel=found["channel"], is_error_frame=True)
    return can.Message(
        timestamp=time_s,
        arbitration_id=number & ID_BITS,
        is_extended_id=is_extended,
        is_remote_frame=is_remote,
        is_fd=is_fd,
        bitrate_switch=has_fast_data,
        is_rx=found["direction"] != "T",
        dlc=length,
        data=None if is_remote else data,
        channel=found["channel"],
    )
