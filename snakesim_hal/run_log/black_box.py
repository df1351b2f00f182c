"""The black box: every tick of a run, in a ring buffer of fixed size that `recorder` writes to disk.

A tick costs one packed copy into memory that was allocated before the run. If it is not emptied, because the disk is
full or hangs, the newest rows are kept.

On disk it is one flat file: a line of JSON that names the columns, then the rows. `read_black_box` reads it, also with
an incomplete last row, as after a SIGKILL.

`command_digest` is a hash over every applied setpoint, so runs with equal digests drove the motors equally.
"""

import hashlib
import struct
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from snakesim_hal.backend import Samples
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.safety.authority import Decision
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Contacts, Description, Pose

MEMORY_BYTES = 16 * 2**20  # about four minutes of 13 joints at 100 Hz
TAKEN_BYTES = 2**18  # at once: the host waits for the interpreter while they are copied, 20 us
HEADER_LIMIT = 2**20
ALIGNED = 64


class Column(msgspec.Struct, frozen=True):
    """One column: a number in every row, or a vector of them."""

    name: Annotated[str, Meta(min_length=1, max_length=60)]
    type: Literal["<f8", "<i8", "|i1"]
    width: Annotated[int, Meta(ge=1, le=4096)] | None = None  # of a vector

    @property
    def format(self) -> Any:
        """NumPy dtype."""
        return self.type if self.width is None else (self.type, (self.width,))

    @property
    def bytes(self) -> int:
        """Size in each row."""
        return np.dtype(self.format).itemsize


class Layout(msgspec.Struct, frozen=True, kw_only=True):
    """The first line of the file: the columns of a row."""

    format: Literal["snakesim.blackbox/1"] = "snakesim.blackbox/1"
    robot: str
    joints: list[str]  # the order within a column
    row_bytes: Annotated[int, Meta(ge=1, le=2**20)]
    columns: list[Column]  # in order; the rest of the row is padding

    @staticmethod
    def of(robot: Description) -> "Layout":
        """The columns for a robot. Names contain the units; vectors are in the frame of `Pose`."""
        joints = len(robot.joints)
        each = ("angle_rad", "velocity_rad_s", "torque_nm", "target", "torque_limit_nm")
        columns = [
            Column("tick", "<i8"),
            Column("time_s", "<f8"),
            *(Column(name, "<f8", joints) for name in each),
            Column("position_w", "<f8", 3),
            Column("orientation_wxyz", "<f8", 4),
            Column("contact_peak_n", "<f8"),
            Column("contact_count", "<f8"),
            Column("mode", "|i1", joints),
        ]
        used = sum(column.bytes for column in columns)
        names = [joint.name for joint in robot.joints]
        return Layout(robot=robot.robot, joints=names, row_bytes=used + -used % 8, columns=columns)

    def header(self) -> bytes:
        """The line, padded so that the rows are aligned."""
        line = msgspec.json.encode(self)
        return line + b" " * (-(len(line) + 1) % ALIGNED) + b"\n"

    def arrays(self, rows: bytes) -> dict[str, NDArray[Any]]:
        """Whole rows as columns, (n,) or (n, width)."""
        offsets = np.cumsum([0, *(column.bytes for column in self.columns)])
        dtype = np.dtype(
            {
                "names": [column.name for column in self.columns],
                "formats": [column.format for column in self.columns],
                "offsets": offsets[:-1].tolist(),
                "itemsize": self.row_bytes,
            }
        )
        table = np.frombuffer(rows, dtype=dtype, count=len(rows) // self.row_bytes)
        return {column.name: table[column.name] for column in self.columns}


class BlackBox:
    """A row a tick; keeps the newest rows until they are read."""

    def __init__(self, description: Description, memory_bytes: int = MEMORY_BYTES) -> None:
        self.layout = Layout.of(description)
        joints = len(description.joints)
        self._pack_into = struct.Struct(f"<qd{5 * joints + 9}d{joints}b").pack_into
        self._capacity = max(memory_bytes // self.layout.row_bytes, 2)
        self._memory = bytearray(b"\0") * (self._capacity * self.layout.row_bytes)  # touched: no page faults
        self._rows = 0
        self._digest = hashlib.sha256()
        self._pack_setpoints = struct.Struct(f"<q{joints}b{2 * joints}d").pack
        self._pose = [np.nan] * 7
        self._contact_peak_n = 0.0
        self._contact_count = 0

    def record(self, tick: int, timestamp_ns: int, samples: Samples, decision: Decision) -> None:
        """Record one tick."""
        pose = samples.others.get(keys.POSE)
        if isinstance(pose, Pose):
            self._pose = [*pose.position_w, *pose.orientation_wxyz]
        contacts = samples.others.get(keys.CONTACTS)
        if isinstance(contacts, Contacts):
            self._contact_peak_n, self._contact_count = touching(contacts)
        joints, points = samples.joints, decision.setpoints
        self._pack_into(
            self._memory,
            self._rows % self._capacity * self.layout.row_bytes,
            tick,
            timestamp_ns * 1e-9,
            *joints.angle_rad,
            *joints.velocity_rad_s,
            *joints.torque_nm,
            *points.target,
            *points.torque_limit_nm,
            *self._pose,
            self._contact_peak_n,
            self._contact_count,
            *points.mode,
        )
        self._digest.update(self._pack_setpoints(tick, *points.mode, *points.target, *points.torque_limit_nm))
        self._rows += 1  # last: another thread reads the counted rows

    @property
    def ticks(self) -> int:
        """Rows recorded so far, read or not."""
        return self._rows

    @property
    def command_digest(self) -> str:
        """Hash of every setpoint applied so far."""
        return self._digest.hexdigest()

    def rows_from(self, row: int) -> tuple[int, bytes]:
        """Some rows from number `row` on, or from the oldest that is still kept: the first one's number, and the rows.

        May be called from another thread: the rows are consistent, also while the host goes on.
        """
        size = self.layout.row_bytes
        while True:
            end = self._rows
            first = max(row, end - self._capacity + 1)  # the oldest row may be overwritten right now
            at = first % self._capacity
            count = min(end - first, self._capacity - at, max(TAKEN_BYTES // size, 1))
            rows = bytes(memoryview(self._memory)[at * size : (at + count) * size])
            if self._rows - first < self._capacity:  # else overwritten meanwhile
                return first, rows


def touching(contacts: Contacts) -> tuple[float, int]:
    """The force of the strongest contact in N, and how many obstacles are touched.

    The force is a mean over 50 ms, see `measured_force`; of a sensor that does not tell it, that of the instant.
    """
    touched = len({contact.obstacle for contact in contacts.contacts})
    if contacts.measured_force_n is not None:
        return contacts.measured_force_n, touched
    squares = [f[0] * f[0] + f[1] * f[1] + f[2] * f[2] for f in (contact.force_l for contact in contacts.contacts)]
    return max(squares, default=0.0) ** 0.5, touched


def read_black_box(path: Path) -> tuple[Layout, dict[str, NDArray[Any]]]:
    """Every complete row of a file that `recorder` wrote. Raises ConfigError for any other file."""
    try:
        with path.open("rb") as file:
            line = file.readline(HEADER_LIMIT)
            layout = msgspec.json.decode(line, type=Layout)
            return layout, layout.arrays(file.read())
    except (OSError, ValueError, RecursionError) as error:  # msgspec's errors are ValueErrors
        raise ConfigError(f"{path} cannot be read as the black box of a run: {str(error)[:200]}") from None


def digest_of(columns: dict[str, NDArray[Any]]) -> str:
    """`command_digest` recomputed from recorded rows, for a host that was killed."""
    names = {"tick": "<i8", "mode": "|i1", "target": "<f8", "torque_limit_nm": "<f8"}
    dtype = [(name, type_, columns[name].shape[1:]) for name, type_ in names.items()]
    packed = np.empty(len(columns["tick"]), dtype=dtype)
    for name in names:
        packed[name] = columns[name]
    return hashlib.sha256(packed.tobytes()).hexdigest()
