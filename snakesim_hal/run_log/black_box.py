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
from typing import Annotated, Any, Literal, Self

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from snakesim_hal.backend import Samples
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.safety.authority import TickOutput
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Contacts, Pose, RobotDescription

MEMORY_BYTES = 16 * 2**20  # about four minutes of 13 joints at 100 Hz
MAX_COPIED_BYTES = 2**18  # in one copy: meanwhile the host waits for the interpreter, about 20 µs
MAX_HEADER_BYTES = 2**20
HEADER_ALIGNMENT_BYTES = 64
ROW_ALIGNMENT_BYTES = 8


class LogColumn(msgspec.Struct, frozen=True):
    """One column: a number in every row, or a vector of them."""

    name: Annotated[str, Meta(min_length=1, max_length=60)]
    type: Literal["<f8", "<i8", "|i1"]
    width: Annotated[int, Meta(ge=1, le=4096)] | None = None  # of a vector

    @property
    def format(self) -> Any:
        """Return the format of the column in a NumPy dtype."""
        if self.width is None:
            return self.type
        return self.type, (self.width,)

    @property
    def bytes(self) -> int:
        """Return the size of the column in each row."""
        return np.dtype(self.format).itemsize


class RowLayout(msgspec.Struct, frozen=True, kw_only=True):
    """The first line of the file: the columns of a row."""

    format: Literal["snakesim.blackbox/1"] = "snakesim.blackbox/1"
    robot: str
    joints: list[str]  # the order within a column
    row_bytes: Annotated[int, Meta(ge=1, le=2**20)]
    columns: list[LogColumn]  # in order; the rest of the row is padding

    @classmethod
    def for_robot(cls, description: RobotDescription) -> Self:
        """Return the layout of a row of the black box for a robot.

        Names of columns contain the units; that of `target` depends on the mode of the joint: rad, rad/s or N·m.
        Position and orientation are those of the tail end in the world frame. A row
        is padded to a multiple of ROW_ALIGNMENT_BYTES. `BlackBox` packs rows in this order of columns.

        Args:
            description: Description of the robot, from which the number and the names of the joints are taken.

        Returns:
            The layout, with the columns in their order in a row.
        """
        joint_count = len(description.joints)
        joint_columns = ("angle_rad", "velocity_rad_s", "torque_nm", "target", "torque_limit_nm")
        columns = [
            LogColumn("tick", "<i8"),
            LogColumn("time_s", "<f8"),
            *(LogColumn(name, "<f8", joint_count) for name in joint_columns),
            LogColumn("position_w_m", "<f8", 3),
            LogColumn("orientation_wxyz", "<f8", 4),
            LogColumn("contact_peak_n", "<f8"),
            LogColumn("contact_count", "<f8"),
            LogColumn("mode", "|i1", joint_count),
        ]
        used_bytes = sum(column.bytes for column in columns)
        padding_bytes = -used_bytes % ROW_ALIGNMENT_BYTES
        joint_names = [joint.name for joint in description.joints]
        return cls(
            robot=description.robot,
            joints=joint_names,
            row_bytes=used_bytes + padding_bytes,
            columns=columns,
        )

    def encode_header(self) -> bytes:
        """Return the first line of the file, padded so that the rows are aligned."""
        line = msgspec.json.encode(self)
        padding_bytes = -(len(line) + 1) % HEADER_ALIGNMENT_BYTES
        return line + b" " * padding_bytes + b"\n"

    def decode_rows(self, rows: bytes) -> dict[str, NDArray[Any]]:
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

    def __init__(self, description: RobotDescription, memory_bytes: int = MEMORY_BYTES) -> None:
        """Allocate the memory for a robot's rows."""
        self.layout = RowLayout.for_robot(description)
        joint_count = len(description.joints)
        # One row, in the order of the columns of `RowLayout.for_robot`: tick, time, five values of each joint, 7 of the
        # pose, 2 of the contacts, and the mode of each joint.
        self._pack_row_into = struct.Struct(f"<qd{5 * joint_count + 9}d{joint_count}b").pack_into
        self._capacity = max(memory_bytes // self.layout.row_bytes, 2)
        # Multiplying writes every byte now, so that recording causes no page faults.
        self._buffer = bytearray(b"\0") * (self._capacity * self.layout.row_bytes)
        self._rows_written = 0
        self._digest = hashlib.sha256()
        # The setpoints of one tick, in the order that `compute_digest` reads: tick, modes, targets, torque limits.
        self._pack_setpoints = struct.Struct(f"<q{joint_count}b{2 * joint_count}d").pack
        # The newest samples, which are repeated in rows without a new sample.
        self._last_pose = [np.nan] * 7
        self._last_contact_peak_n = 0.0
        self._last_contact_count = 0

    def record_tick(
        self, tick: int, timestamp_ns: int, samples: Samples, decision: TickOutput
    ) -> None:
        """Append the row of one tick to the ring buffer, and update the digest of the setpoints.

        Args:
            tick: Number of the tick.
            timestamp_ns: Robot time of the tick.
            samples: Joint states of this tick, and new samples of other sensors by key. Without a new sample of pose or
                contacts, the values of the last row are repeated.
            decision: Setpoints that are applied in this tick.
        """
        pose = samples.by_key.get(keys.POSE)
        if isinstance(pose, Pose):
            self._last_pose = [*pose.position_w, *pose.orientation_wxyz]
        contacts = samples.by_key.get(keys.CONTACTS)
        if isinstance(contacts, Contacts):
            self._last_contact_peak_n, self._last_contact_count = summarize_contacts(contacts)
        joints = samples.joints
        setpoints = decision.setpoints
        buffer_offset = self._rows_written % self._capacity * self.layout.row_bytes
        # The order of the arguments is that of the columns in `RowLayout.for_robot`.
        self._pack_row_into(
            self._buffer,
            buffer_offset,
            tick,
            timestamp_ns * 1e-9,
            *joints.angle_rad,
            *joints.velocity_rad_s,
            *joints.torque_nm,
            *setpoints.target,
            *setpoints.torque_limit_nm,
            *self._last_pose,
            self._last_contact_peak_n,
            self._last_contact_count,
            *setpoints.mode,
        )
        # The order of the arguments is that of `compute_digest`.
        packed = self._pack_setpoints(
            tick, *setpoints.mode, *setpoints.target, *setpoints.torque_limit_nm
        )
        self._digest.update(packed)
        # Last, because the writer's thread, which calls `read_rows`, reads all rows that are counted.
        self._rows_written += 1

    @property
    def row_count(self) -> int:
        """Return how many rows were recorded so far, read or not."""
        return self._rows_written

    @property
    def command_digest(self) -> str:
        """Return the hash of every setpoint applied so far."""
        return self._digest.hexdigest()

    def read_rows(self, start_row: int) -> tuple[int, bytes]:
        """Return some recorded rows from a row on, or from the oldest row that was not overwritten yet.

        May be called from another thread: the rows are consistent, also while the host records.

        Args:
            start_row: Number of the first row to read, counted from 0 since the start of the recording.

        Returns:
            Number of the first row that is returned, and the bytes of the rows. The bytes are empty if there is no new
            row. They end at the end of the ring buffer, or after MAX_COPIED_BYTES, so more rows may be left.
        """
        row_bytes = self.layout.row_bytes
        while True:
            end = self._rows_written
            # The oldest row may be overwritten right now.
            first_row = max(start_row, end - self._capacity + 1)
            position = first_row % self._capacity  # in the ring buffer
            count = min(
                end - first_row, self._capacity - position, max(MAX_COPIED_BYTES // row_bytes, 1)
            )
            rows = bytes(
                memoryview(self._buffer)[position * row_bytes : (position + count) * row_bytes]
            )
            # Otherwise the host has overwritten them meanwhile.
            if self._rows_written - first_row < self._capacity:
                return first_row, rows


def summarize_contacts(contacts: Contacts) -> tuple[float, int]:
    """Return the force of the strongest contact in N, and the number of touched obstacles.

    The force is the mean over 50 ms that the sensor measures, see `measured_force`. If the sample has no such mean, the
    force is the largest contact force of this tick.
    """
    touched_count = len({contact.obstacle for contact in contacts.contacts})
    if contacts.measured_force_n is not None:
        return contacts.measured_force_n, touched_count
    squared_forces: list[float] = []
    for contact in contacts.contacts:
        x, y, z = contact.force_l
        squared_forces.append(x * x + y * y + z * z)
    return max(squared_forces, default=0.0) ** 0.5, touched_count


def read_black_box(path: Path) -> tuple[RowLayout, dict[str, NDArray[Any]]]:
    """Read every complete row of a black box file.

    Args:
        path: Path of the file.

    Returns:
        The layout of the file, and the columns by name, each of shape (rows,) or (rows, width).

    Raises:
        ConfigError: The file is not the black box of a run, or cannot be read.
    """
    try:
        with path.open("rb") as file:
            header = file.readline(MAX_HEADER_BYTES)
            layout = msgspec.json.decode(header, type=RowLayout)
            return layout, layout.decode_rows(file.read())
    except (OSError, ValueError, RecursionError) as error:  # msgspec's errors are ValueErrors
        raise ConfigError(
            f"{path} cannot be read as the black box of a run: {str(error)[:200]}",
            code="recording/not-readable",
        ) from None


def compute_digest(columns: dict[str, NDArray[Any]]) -> str:
    """Compute the `command_digest` of a run from its recorded rows, for a host that was killed.

    Args:
        columns: Columns of the black box by name, as `read_black_box` returns them.
    """
    # The same order as in `BlackBox.record`.
    column_types = {"tick": "<i8", "mode": "|i1", "target": "<f8", "torque_limit_nm": "<f8"}
    dtype = [(name, type_, columns[name].shape[1:]) for name, type_ in column_types.items()]
    packed = np.empty(len(columns["tick"]), dtype=dtype)
    for name in column_types:
        packed[name] = columns[name]
    return hashlib.sha256(packed.tobytes()).hexdigest()
