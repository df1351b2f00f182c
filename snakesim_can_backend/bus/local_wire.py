"""A CAN bus between the programs of one user on this computer, without CAN in the kernel: `local:FOLDER`.

The bus is a folder. Every program on it has a named pipe there, its inbox, and writes each frame into the inboxes of
all others. No program is special, and programs join and leave at any time:

    program A                 FOLDER                  program B
    send ----------------> B's inbox (pipe) -------> receive
    receive <------------- A's inbox (pipe) <------- send

A program that does not read loses frames, as a CAN controller does: its inbox is full, and no other program waits for
it. The writer counts the lost frames, and reports them to the reader with the next frame that fits. A record of one
frame is smaller than PIPE_BUF, so that the kernel writes all of it or nothing.

There are no bit rate and no arbitration. The bus is for emulated drives. The reference firmware in C has the same bus:
`snakesim_native/joint_module/host/local_bus.c`.
"""

import contextlib
import errno
import fcntl
import math
import os
import struct
import time
import uuid
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from snakesim_can_backend.bus.bus import IO_ERRORS, LAST_STANDARD_ID, MAX_AT_ONCE
from snakesim_can_backend.bus.bus_errors import BusError
from snakesim_can_backend.bus.faultable_wire import FaultableWire
from snakesim_can_backend.protocol.definitions import NODE_BITS, CanFrame, Opcode
from snakesim_hal.base.errors import BackendError, ConfigError

LOCAL: Final = "local"  # a channel is `local:FOLDER`
INBOX_SUFFIX = ".can"
MAX_JOIN_ATTEMPTS = 10
INBOX_BYTES = 1 << 20  # 13000 frames: more than a second of a full bus
OTHER_USERS = 0o077  # permission bits that a folder must not have

# A record: magic, frames that the writer lost for this reader since its last record, id, data length, data.
MAGIC = b"CAN\x01"
RECORD_FORMAT = struct.Struct("<4sIIB3x64s")
MAX_CLASSIC_BYTES = 8
MAX_FD_BYTES = 64
MAX_LOST_COUNT = 0xFFFF_FFFF
READ_BYTES = 800 * RECORD_FORMAT.size
# File systems store times in steps of up to 10 ms: a folder that changed just now may change again unnoticed.
SETTLED_AFTER_NS = 100_000_000


def validate_local_bus(folder: str) -> None:
    """Check that a program is on a bus already, for programs that need drives there.

    Args:
        folder: Folder of the bus.

    Raises:
        ConfigError: There is no such bus, no program is on it, or other users can enter it.
    """
    channel = f"{LOCAL}:{folder}"
    way_out = f"start emulated drives: `snakesim drive emulate TYPE SCENARIO --channel {channel}`"
    if not Path(folder).is_dir():
        raise ConfigError(
            f"channel {channel!r}: there is no such bus; {way_out}", code="bus/not-available"
        )
    _validate_folder(Path(folder), channel)
    for path in Path(folder).glob(f"*{INBOX_SUFFIX}"):
        with contextlib.suppress(OSError):  # the program of this inbox has ended
            os.close(_open_for_writing(path))
            return
    raise ConfigError(
        f"channel {channel!r}: no program is on this bus; {way_out}", code="bus/not-available"
    )


@dataclass
class _Destination:
    """The inbox of another program on the bus."""

    path: Path
    descriptor: int  # open for writing
    lost_count: int = 0  # frames that did not fit since the last frame that did


class LocalWire(FaultableWire):
    """One end of a bus between the programs of one user."""

    def __init__(
        self, folder: str, received_opcodes: Iterable[Opcode] | None = None, *, fd: bool = False
    ) -> None:
        """Join a bus, and create it if there is none.

        Args:
            folder: Folder of the bus.
            received_opcodes: Opcodes of the messages to receive; None for all messages.
            fd: Whether the bus is CAN FD. On classic CAN, this end ignores 29-bit ids and more than 8 bytes.

        Raises:
            ConfigError: Other users can enter the folder.
            BackendError: The folder cannot be created or used.
        """
        super().__init__(f"{LOCAL}:{folder}")
        self._folder = Path(folder).absolute()
        self._received_opcodes = (
            None if received_opcodes is None else frozenset(map(int, received_opcodes))
        )
        self._uses_fd = fd
        self._inbox_path = self._folder / f"{os.getpid()}-{uuid.uuid4().hex[:8]}{INBOX_SUFFIX}"
        try:
            self._inbox = self._join()
        except OSError as error:
            raise BackendError(
                f"{self.channel}: cannot be opened: {error}", code="bus/cannot-open"
            ) from error

        # The other programs on the bus, by the names of their inboxes.
        self._destination_by_name: dict[str, _Destination] = {}
        self._listed_time_ns = 0  # when the folder had changed, at the last listing
        self._is_list_settled = False

        # For `errors`: since the last call.
        self._lost_by_this_end_count = 0
        self._lost_for_others_count = 0
        self._has_met_others = False  # whether another program has been on the bus
        self._is_down_reported = False  # whether the last report is that all others have left

    def fileno(self) -> int | None:
        """Return the file descriptor of the inbox."""
        return self._inbox

    def idle(self) -> float | None:
        """Return infinity, because a frame may arrive at any time."""
        return math.inf

    def errors(self) -> list[BusError]:
        """Return the errors since the last call: lost frames, whether this end is alone, and injected errors.

        The bus is down when the last other program has left. Before the first one joins, nothing is reported.
        """
        self._update_destinations()
        errors: list[BusError] = []
        if self._lost_by_this_end_count:
            detail = (
                f"{self._lost_by_this_end_count} frames were lost: this process reads too slowly"
            )
            errors.append(BusError("receive_overflow", self.channel, detail))
        if self._lost_for_others_count:
            detail = f"{self._lost_for_others_count} frames were lost by programs that do not read"
            errors.append(BusError("queue_full", self.channel, detail))
        self._lost_by_this_end_count = 0
        self._lost_for_others_count = 0
        is_down = self._has_met_others and not self._destination_by_name
        if is_down and not self._is_down_reported:
            detail = "no other program is on the bus any more"
            errors.append(BusError("interface_down", self.channel, detail))
        if self._is_down_reported and not is_down:
            detail = "another program is on the bus again"
            errors.append(BusError("interface_up", self.channel, detail))
        self._is_down_reported = is_down
        return errors + super().errors()

    def close(self) -> None:
        """Leave the bus. The last program that leaves removes the folder."""
        try:
            self._inbox_path.unlink(missing_ok=True)
            self._close_destinations()
            self._update_destinations()  # which opens all again, but removes those of killed programs
            self._close_destinations()
            os.close(self._inbox)
        except IO_ERRORS as error:
            raise BackendError(
                f"{self.channel}: cannot be closed: {error}", code="bus/io-failed"
            ) from error
        with contextlib.suppress(OSError):  # another program is on the bus
            self._folder.rmdir()

    def _join(self) -> int:
        """Create the folder if there is none, and the inbox; return its file descriptor. Raises OSError."""
        for _ in range(MAX_JOIN_ATTEMPTS):
            self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with contextlib.suppress(FileNotFoundError):  # the last program has just left the bus
                _validate_folder(self._folder, self.channel)
                return _create_inbox(self._inbox_path)
        raise FileNotFoundError(errno.ENOENT, "other programs remove the folder", str(self._folder))

    def _send_frame(self, frame: CanFrame) -> bool:
        """Write a frame into all other inboxes, and never wait. A full inbox loses it."""
        if len(frame.data) > MAX_FD_BYTES:
            raise BackendError(
                f"{self.channel}: cannot send: the frame {frame.id:#x} has {len(frame.data)} bytes, at most "
                f"{MAX_FD_BYTES}",
                code="bus/io-failed",
            )
        self._update_destinations()
        for name, destination in list(self._destination_by_name.items()):
            record = RECORD_FORMAT.pack(
                MAGIC, destination.lost_count, frame.id, len(frame.data), frame.data
            )
            try:
                os.write(destination.descriptor, record)
                destination.lost_count = 0
            except BlockingIOError:
                destination.lost_count = min(destination.lost_count + 1, MAX_LOST_COUNT)
                self._lost_for_others_count += 1
            except OSError:
                self._forget_destination(name)
        return True

    def _receive_frames(self) -> list[CanFrame]:
        frames: list[CanFrame] = []
        with contextlib.suppress(BlockingIOError):
            while len(frames) < MAX_AT_ONCE:
                self._decode_records(os.read(self._inbox, READ_BYTES), frames)
        return frames

    def _decode_records(self, data: bytes, frames: list[CanFrame]) -> None:
        """Append the frames in whole records. Bytes between records, which no wire writes, are skipped."""
        begin = data.find(MAGIC)
        last_begin = len(data) - RECORD_FORMAT.size
        while 0 <= begin <= last_begin:
            _, lost_count, identifier, length, payload = RECORD_FORMAT.unpack_from(data, begin)
            self._lost_by_this_end_count += lost_count
            if self._should_receive(identifier, length):
                frames.append(CanFrame(identifier, payload[:length]))
            begin = data.find(MAGIC, begin + RECORD_FORMAT.size)

    def _should_receive(self, identifier: int, length: int) -> bool:
        if length > MAX_FD_BYTES:
            return False
        if not self._uses_fd and (identifier > LAST_STANDARD_ID or length > MAX_CLASSIC_BYTES):
            return False
        return self._received_opcodes is None or identifier >> NODE_BITS in self._received_opcodes

    def _update_destinations(self) -> None:
        """Find the programs that have joined or left since the last call, by the time when the folder changed."""
        try:
            changed_ns = self._folder.stat().st_mtime_ns
            if changed_ns == self._listed_time_ns and self._is_list_settled:
                return
            self._is_list_settled = time.time_ns() - changed_ns > SETTLED_AFTER_NS
            names = {
                name
                for name in os.listdir(self._folder)  # noqa: PTH208 - names alone
                if name.endswith(INBOX_SUFFIX) and not name.startswith(".")
            }
            names.discard(self._inbox_path.name)
        except OSError:  # the folder is gone
            names = set()
            changed_ns = 0
        self._listed_time_ns = changed_ns
        for name in self._destination_by_name.keys() - names:
            os.close(self._destination_by_name.pop(name).descriptor)
        for name in names - self._destination_by_name.keys():
            self._add_destination(name)

    def _add_destination(self, name: str) -> None:
        """Open an inbox, or remove it if its program was killed."""
        path = self._folder / name
        try:
            self._destination_by_name[name] = _Destination(path, _open_for_writing(path))
            self._has_met_others = True
        except OSError as error:
            if error.errno == errno.ENXIO:  # no process reads it
                path.unlink(missing_ok=True)

    def _close_destinations(self) -> None:
        for destination in self._destination_by_name.values():
            os.close(destination.descriptor)
        self._destination_by_name.clear()

    def _forget_destination(self, name: str) -> None:
        """Remove the inbox of a program that has ended."""
        destination = self._destination_by_name.pop(name)
        os.close(destination.descriptor)
        with contextlib.suppress(OSError):
            destination.path.unlink(missing_ok=True)


def _validate_folder(folder: Path, channel: str) -> None:
    """Raise ConfigError if another user can enter a folder."""
    status = folder.stat()
    if status.st_uid != os.geteuid() or status.st_mode & OTHER_USERS:
        raise ConfigError(
            f"channel {channel!r}: other users can enter this folder, and could command the drives; name a folder "
            "that does not exist, which is then created for this user only",
            code="bus/invalid-channel",
        )


def _create_inbox(path: Path) -> int:
    """Create a named pipe, and return its file descriptor. It has its name only when it can be written to.

    It is open for writing, too, so that it does not end when the last writer leaves it.
    """
    new_path = path.with_name(f".{path.name}")
    os.mkfifo(new_path, 0o600)
    inbox = os.open(new_path, os.O_RDWR | os.O_NONBLOCK)
    with contextlib.suppress(OSError):  # this user's pipes have all the memory that they may have
        fcntl.fcntl(inbox, fcntl.F_SETPIPE_SZ, INBOX_BYTES)
    new_path.rename(path)
    return inbox


def _open_for_writing(path: Path) -> int:
    """Open another program's inbox. Raises OSError, with ENXIO if no process reads it."""
    if not path.is_fifo():
        raise FileNotFoundError(errno.ENOENT, "not a named pipe", str(path))
    return os.open(path, os.O_WRONLY | os.O_NONBLOCK)
