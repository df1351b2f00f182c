"""The black box: every tick of a run, in a ring buffer of fixed size that `recorder` writes to disk.

A tick costs one packed copy into memory that was allocated before the run. If it is not emptied, because the disk is
full or hangs, the newest rows stay.

On disk it is one flat file: a line of JSON that names the columns, then the rows. `read_black_box` reads it, also with
an incomplete last row, as after a SIGKILL.

`command_digest` is a hash over every applied setpoint, so runs with equal digests drove the motors equally.

Threads: the host's thread records; the writer's thread reads rows with `read_rows` meanwhile, without a lock.
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
from snakesim_hal.safety.authority import TickDecision
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Contacts, Description, Pose

MEMORY_BYTES = 16 * 2**20  # about four minutes of 13 joints at 100 Hz
COPIED_BYTES = 2**18  # at once, at most: the host waits for the interpreter while they are copied, 20 us
HEADER_LIMIT_BYTES = 2**20
HEADER_ALIGNMENT_BYTES = 64
ROW_ALIGNMENT_BYTES = 8


class Column(msgspec.Struct, frozen=True):
    """One column: a number in every row, or a vector of them."""

    name: Annotated[str, Meta(min_length=1, max_length=60)]
    type: Literal["<f8", "<i8", "|i1"]
    width: Annotated[int, Meta(ge=1, le=4096)] | None = None  # of a vector

    @property
    def format(self) -> Any:
        """Return what NumPy makes a dtype of."""
        if self.width is None:
            return self.type
        return self.type, (self.width,)

    @property
    def bytes(self) -> int:
        """Return its size in each row."""
        return np.dtype(self.format).itemsize


class Layout(msgspec.Struct, frozen=True, kw_only=True):
    """The first line of the file: the columns of a row."""

    format: Literal["snakesim.blackbox/1"] = "snakesim.blackbox/1"
    robot: str
    joints: list[str]  # the order within a column
    row_bytes: Annotated[int, Meta(ge=1, le=2**20)]
    columns: list[Column]  # in order; the rest of the row is padding

    @staticmethod
    def for_robot(robot: Description) -> "Layout":
        """Return the layout of a row for a robot.

        Names of columns contain the units. Position and orientation are those of the tail end in the world. A row is
        padded to a multiple of ROW_ALIGNMENT_BYTES.
        """
        joint_count = len(robot.joints)
        joint_columns = ("angle_rad", "velocity_rad_s", "torque_nm", "target", "torque_limit_nm")
        columns = [
            Column("tick", "<i8"),
            Column("time_s", "<f8"),
            *(Column(name, "<f8", joint_count) for name in joint_columns),
            Column("position_w_m", "<f8", 3),
            Column("orientation_wxyz", "<f8", 4),
            Column("contact_peak_n", "<f8"),
            Column("contact_count", "<f8"),
            Column("mode", "|i1", joint_count),
        ]
        used_bytes = sum(column.bytes for column in columns)
        padding_bytes = -used_bytes % ROW_ALIGNMENT_BYTES
        joint_names = [joint.name for joint in robot.joints]
        return Layout(robot=robot.robot, joints=joint_names, row_bytes=used_bytes + padding_bytes, columns=columns)

    def header(self) -> bytes:
        """Return the first line of the file, padded so that the rows are aligned."""
        line = msgspec.json.encode(self)
        padding_bytes = -(len(line) + 1) % HEADER_ALIGNMENT_BYTES
        return line + b" " * padding_bytes + b"\n"

    def arrays(self, rows: bytes) -> dict[str, NDArray[Any]]:
        """Return whole rows as columns by name, each of shape (n,) or (n, width)."""
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
    """Records a row in each tick, and keeps the newest rows until they are read."""

    def __init__(self, description: Description, memory_bytes: int = MEMORY_BYTES) -> None:
        """Allocate the memory for a robot's rows."""
        self.layout = Layout.for_robot(description)
        joints = len(description.joints)
        self._pack_into = struct.Struct(f"<qd{5 * joints + 9}d{joints}b").pack_into
        self._capacity = max(memory_bytes // self.layout.row_bytes, 2)
        # Multiplying writes every byte now, so that recording causes no page faults.
        self._memory = bytearray(b"\0") * (self._capacity * self.layout.row_bytes)
        self._rows = 0  # recorded so far
        self._digest = hashlib.sha256()
        self._pack_setpoints = struct.Struct(f"<q{joints}b{2 * joints}d").pack
        self._pose = [np.nan] * 7
        self._contact_peak_n = 0.0
        self._contact_count = 0

    def record(self, tick: int, timestamp_ns: int, samples: Samples, decision: TickDecision) -> None:
        """Append the row of one tick to the ring of rows, and update the digest of the setpoints.

        Args:
            tick: number of the tick.
            timestamp_ns: robot time of the tick.
            samples: the joint states of this tick, and other samples by key. Pose and contacts without a new sample
                are repeated from the row before.
            decision: the setpoints that are applied in this tick.
        """
        pose = samples.others.get(keys.POSE)
        if isinstance(pose, Pose):
            self._pose = [*pose.position_w, *pose.orientation_wxyz]
        contacts = samples.others.get(keys.CONTACTS)
        if isinstance(contacts, Contacts):
            self._contact_peak_n, self._contact_count = summarize_contacts(contacts)
        joints = samples.joints
        setpoints = decision.setpoints
        offset = self._rows % self._capacity * self.layout.row_bytes
        self._pack_into(
            self._memory,
            offset,
            tick,
            timestamp_ns * 1e-9,
            *joints.angle_rad,
            *joints.velocity_rad_s,
            *joints.torque_nm,
            *setpoints.target,
            *setpoints.torque_limit_nm,
            *self._pose,
            self._contact_peak_n,
            self._contact_count,
            *setpoints.mode,
        )
        packed = self._pack_setpoints(tick, *setpoints.mode, *setpoints.target, *setpoints.torque_limit_nm)
        self._digest.update(packed)
        self._rows += 1  # last: another thread reads the counted rows

    @property
    def ticks(self) -> int:
        """Return how many rows were recorded so far, read or not."""
        return self._rows

    @property
    def command_digest(self) -> str:
        """Return the hash of every setpoint applied so far."""
        return self._digest.hexdigest()

    def read_rows(self, row: int) -> tuple[int, bytes]:
        """Return some rows from number `row` on, or from the oldest row that is still there.

        May be called from another thread: the rows are consistent, also while the host records.

        Returns:
            The number of the first returned row, and the bytes of the rows.
        """
        size = self.layout.row_bytes
        while True:
            end = self._rows
            first = max(row, end - self._capacity + 1)  # the oldest row may be overwritten right now
            begin = first % self._capacity  # position in the ring
            count = min(end - first, self._capacity - begin, max(COPIED_BYTES // size, 1))
            rows = bytes(memoryview(self._memory)[begin * size : (begin + count) * size])
            if self._rows - first < self._capacity:  # otherwise the host has overwritten them meanwhile
                return first, rows


def summarize_contacts(contacts: Contacts) -> tuple[float, int]:
    """Return the force of the strongest contact in N, and the number of touched obstacles.

    The force is the mean over 50 ms that the sensor measures, see `measured_force`; without one, it is the largest
    contact force of this tick.
    """
    touched = len({contact.obstacle for contact in contacts.contacts})
    if contacts.measured_force_n is not None:
        return contacts.measured_force_n, touched
    squares: list[float] = []
    for contact in contacts.contacts:
        x, y, z = contact.force_l
        squares.append(x * x + y * y + z * z)
    return max(squares, default=0.0) ** 0.5, touched


def read_black_box(path: Path) -> tuple[Layout, dict[str, NDArray[Any]]]:
    """Read every complete row of a black box file.

    Returns:
        The layout of the file, and its columns by name.

    Raises:
        ConfigError: it is not the black box of a run, or cannot be read.
    """
    try:
        with path.open("rb") as file:
            header = file.readline(HEADER_LIMIT_BYTES)
            layout = msgspec.json.decode(header, type=Layout)
            return layout, layout.arrays(file.read())
    except (OSError, ValueError, RecursionError) as error:  # msgspec's errors are ValueErrors
        raise ConfigError(
            f"{path} cannot be read as the black box of a run: {str(error)[:200]}", code="recording/not-readable"
        ) from None


def compute_digest(columns: dict[str, NDArray[Any]]) -> str:
    """Compute `command_digest` from recorded rows, for a host that was killed."""
    names = {"tick": "<i8", "mode": "|i1", "target": "<f8", "torque_limit_nm": "<f8"}
    dtype = [(name, type_, columns[name].shape[1:]) for name, type_ in names.items()]
    packed = np.empty(len(columns["tick"]), dtype=dtype)
    for name in names:
        packed[name] = columns[name]
    return hashlib.sha256(packed.tobytes()).hexdigest()
