"""Reads a log of a CAN bus: every complete frame, and which lines are not complete frames.

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

FILE_SUFFIXES = ".log, .asc, .blf"
MAX_NAMED_LINES = 3  # dropped lines that are shown; the others are counted
MAX_SHOWN_CHARACTERS = 60  # of a dropped line
MAX_ERROR_CHARACTERS = 200  # of an error of python-can
MAX_PROBED_LINES = 500  # to know whether their times are differences
FRAME_INTERVAL_S = 1e-6  # between frames of a log without times
ERROR_FLAG = 0x20000000  # in the id of an error frame
ID_MASK = 0x1FFFFFFF  # id without flags
EXTENDED_ID_DIGITS = 8  # a shorter id has 11 bits
BIT_RATE_SWITCH_FLAG = 1  # flag of CAN FD: the data had a second bit rate

COMPACT_LINE_PATTERN = re.compile(  # (1700000000.000000) can0 105#00112233 R
    r"\((?P<time>\d+\.\d+)\)\s+(?P<channel>\S+)\s+(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})"
    r"#(?:(?P<remote>R\d?)|(?P<flags>#[0-9A-Fa-f])?(?P<data>(?:[0-9A-Fa-f]{2})*)(?:_[0-9A-F])?)"
    r"(?:\s+(?P<direction>[RT]))?\s*"
)
PRINTED_LINE_PATTERN = (
    re.compile(  # can0  105   [8]  00 11 22 33 44 55 66 77; of CAN FD the length has two digits
        r"\s*(?:\((?P<time>[^)]+)\)\s+)?(?P<channel>\S+)\s+(?:(?P<direction>[RT])X\s+\S+\s+\S+\s+)?"
        r"(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})\s+\[(?P<length>\d{1,2})\](?P<rest>.*)"
    )
)
HEX_BYTE_PATTERN = re.compile(r"\s+([0-9A-Fa-f]{2})(?=\s|$)")


@dataclass(frozen=True)
class DroppedLine:
    """A line, or the rest of a file, that is not a complete frame."""

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
        """Yield every complete frame. Raises ConfigError for a file without any, if it is not empty."""
        messages = self._read_candump() if self._is_candump() else self._read_by_python_can()
        frames = 0
        for message in messages:
            frames += 1
            yield message
        if frames == 0 and self.dropped:
            raise self._make_read_error(str(self.dropped[0]))

    def report(self) -> Iterator[str]:
        """Yield lines for a person: what was left out, and what is not known of the rest."""
        if self.dropped_count:
            subject = "1 line is not a complete frame and was"
            if self.dropped_count > 1:
                subject = f"{self.dropped_count} lines are not complete frames and were"
            named = "; ".join(str(line) for line in self.dropped)
            unnamed_count = self.dropped_count - len(self.dropped)
            more = f"; and {unnamed_count} more" if unnamed_count else ""
            yield f"{subject} left out: {named}{more}"
        if not self.has_times:
            yield "the frames have no times (candump -t a has): an answer counts as in time until the next Sync"

    # --- candump ------------------------------------------------------------------------------------------------

    def _is_candump(self) -> bool:
        suffixes = [suffix.lower() for suffix in self.path.suffixes]
        return suffixes[-1:] == [".log"] or suffixes[-2:] == [".log", ".gz"]

    def _read_candump(self) -> Iterator[can.Message]:
        has_relative_times = self._has_relative_times()
        time_s = 0.0
        for number, line in self._read_lines():
            if not line.strip():
                continue
            message = parse_line(line)
            if message is None:
                self._record_dropped_line(f"line {number}", line)
                continue
            if not message.timestamp:
                message.timestamp = time_s + FRAME_INTERVAL_S
            elif has_relative_times:
                message.timestamp += time_s
            time_s = message.timestamp
            yield message

    def _has_relative_times(self) -> bool:
        """Return whether each time is the one since the frame before; also set `has_times`.

        `candump -t d` prints such times. They are differences, so that some of them are smaller than the one before.
        """
        times_s: list[float] = []
        for _, line in islice(self._read_lines(), MAX_PROBED_LINES):
            message = parse_line(line)
            if message is not None:
                times_s.append(message.timestamp)
        self.has_times = not times_s or any(times_s)
        return any(after_s < before_s for before_s, after_s in pairwise(times_s))

    def _read_lines(self) -> Iterator[tuple[int, str]]:
        number = 0
        try:
            with closing(self._open_file()) as file:
                for number, line in enumerate(file, start=1):
                    yield number, line.decode("utf-8", errors="replace")
        except OSError as error:
            raise self._make_read_error(error.strerror or str(error)) from None
        except EOFError as error:  # a compressed file that was cut
            self._record_dropped_line(f"after line {number}", str(error))

    def _open_file(self) -> gzip.GzipFile | BinaryIO:
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
                raise self._make_read_error(str(error)[:MAX_ERROR_CHARACTERS]) from None
            self._record_dropped_line(f"after frame {frames}", str(error) or type(error).__name__)

    # --- inside -------------------------------------------------------------------------------------------------

    def _record_dropped_line(self, where: str, text: str) -> None:
        self.dropped_count += 1
        if len(self.dropped) >= MAX_NAMED_LINES:
            return
        shown = repr(text.rstrip("\r\n"))
        if len(shown) > MAX_SHOWN_CHARACTERS:
            shown = f"{shown[:MAX_SHOWN_CHARACTERS]}..."
        self.dropped.append(DroppedLine(where, shown))

    def _make_read_error(self, reason: str) -> ConfigError:
        return ConfigError(
            f"{self.path} cannot be read as a log of a CAN bus ({FILE_SUFFIXES}): {reason}",
            code="recording/not-readable",
        )


def parse_line(line: str) -> can.Message | None:
    """Parse a line of candump, and return its frame; None if the line is incomplete.

    A timestamp of 0 means that the line has none.
    """
    compact = COMPACT_LINE_PATTERN.fullmatch(line)
    if compact is not None:
        # A line without its end may have lost bytes, but not if the direction is there, which comes after them.
        is_whole = line.endswith("\n") or compact["direction"] is not None
        return _parse_compact(compact) if is_whole else None
    printed = PRINTED_LINE_PATTERN.fullmatch(line.rstrip("\r\n"))
    if printed is not None:
        return _parse_printed(printed)
    return None


def _parse_compact(match: re.Match[str]) -> can.Message:
    """Return the CAN frame of a line in the compact format of `candump -L`.

    Args:
        match: Match of `COMPACT_LINE_PATTERN` with the parts of the line.
    """
    data = bytes.fromhex(match["data"] or "")
    flags = match["flags"]  # such as "#1"; None: classic CAN
    has_fast_data = flags is not None and bool(int(flags[1:], 16) & BIT_RATE_SWITCH_FLAG)
    remote = match["remote"]  # such as "R8", with the length; None: a data frame
    length = len(data)
    if remote:
        length = int(remote[1:] or 0)
    return _make_can_message(
        match,
        float(match["time"]),
        data,
        is_fd=flags is not None,
        has_fast_data=has_fast_data,
        is_remote=remote is not None,
        length=length,
    )


def _parse_printed(match: re.Match[str]) -> can.Message | None:
    """Return the frame of a line that candump prints on a terminal; None if bytes are missing."""
    length = int(match["length"])
    is_fd = len(match["length"]) > 1
    is_remote = match["rest"].strip().startswith("remote request")
    hex_bytes = HEX_BYTE_PATTERN.findall(match["rest"])[:length]
    data = bytes.fromhex("".join(hex_bytes))
    time_s = _parse_time(match["time"])
    if time_s is None or (len(data) < length and not is_remote):
        return None
    return _make_can_message(match, time_s, data, is_fd=is_fd, is_remote=is_remote, length=length)


def _parse_time(text: str | None) -> float | None:
    """Return a time that candump prints, seconds or a date, in seconds; 0 if there is none, None for anything else."""
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


def _make_can_message(
    match: re.Match[str],
    time_s: float,
    data: bytes,
    *,
    is_fd: bool,
    is_remote: bool,
    length: int,
    has_fast_data: bool = False,
) -> can.Message:
    """Return the CAN frame of a line of a log, with the id, channel and direction of that line.

    Args:
        match: Match with the parts of the line: `id`, `channel` and `direction`.
        time_s: Timestamp of the line; 0 if the line has none.
        data: Data bytes.
        is_fd: Whether it is a frame of CAN FD.
        is_remote: Whether it is a remote frame, which has a length but no data.
        length: Number of data bytes, or the length that a remote frame requests.
        has_fast_data: Whether the data were sent at the second bit rate.
    """
    identifier = int(match["id"], 16)
    is_extended = len(match["id"]) == EXTENDED_ID_DIGITS
    if is_extended and identifier & ERROR_FLAG:
        return can.Message(timestamp=time_s, channel=match["channel"], is_error_frame=True)
    return can.Message(
        timestamp=time_s,
        arbitration_id=identifier & ID_MASK,
        is_extended_id=is_extended,
        is_remote_frame=is_remote,
        is_fd=is_fd,
        bitrate_switch=has_fast_data,
        is_rx=match["direction"] != "T",
        dlc=length,
        data=None if is_remote else data,
        channel=match["channel"],
    )
