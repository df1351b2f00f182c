"""Replays a log of the bus through the code with which the driver reads a bus: the joint states of every tick.

A tick begins at its Sync. Its sample is taken when all awaited modules have answered, or when the driver would no
longer have waited for them. Frames that were received together have one time in the log, and are read together here.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby

import can
import numpy as np

from snakesim_can_backend.bus.load import ReportSchedule
from snakesim_can_backend.bus.unknown_frames import guess_frame_origin, is_joint_module_frame
from snakesim_can_backend.driver.reports import ModuleReports
from snakesim_can_backend.driver.sensors import are_contacts_due, to_joint_values
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import FROM_HOST, CanFrame, Opcode, parse_opcode
from snakesim_drivers.mounting import DriveMounting
from snakesim_hal.base.arrays import Floats
from snakesim_hal.run_log.black_box import RowLayout

SYNC_BYTES = load_layouts()[Opcode.SYNC].length
SYNC_COUNT_MASK = 0xFF  # the first byte of a Sync is the lowest 8 bits of its number
MAX_BRING_UP_SYNCS = 64  # before the first tick
QUANTITIES = ("angle_rad", "velocity_rad_s", "torque_nm")


class LogReplay:
    """Reads a log frame by frame as the driver reads a bus, and collects the joint states of every Sync."""

    def __init__(
        self, mounting: DriveMounting, schedule: ReportSchedule, response_timeout_s: float
    ) -> None:
        """Prepare to read the log of a bus as the driver would have read the bus.

        Args:
            mounting: Sign, gear and zero of every joint, to convert values at the modules' shafts to the joints.
            schedule: Which reports the modules send, and how often.
            response_timeout_s: How long the driver waits for the answers to a Sync.
        """
        joints = len(mounting.sign)
        self._mounting = mounting
        self._schedule = schedule
        self._response_timeout_s = response_timeout_s
        # Log time at which the wait for the answers to the newest Sync ends; None: its sample has been taken.
        self._response_deadline_s: float | None = None
        self.reports = ModuleReports(joints)

        # Results.
        self.frames = 0
        self.other_protocol_frames: Counter[str] = Counter()  # by likely origin
        self.joints: list[Floats] = []  # by Sync: VALUES of all joints, (3, n_joints)
        self.unanswered_syncs = [0] * joints  # by joint: Syncs without an answer in time

    def read(self, log: Iterable[can.Message]) -> None:
        """Read a whole log.

        It may end in the middle of a tick. Then the missing answers to the last Sync are unknown, and no sample is
        taken.
        """
        for (time_s, _), messages in groupby(
            log, key=lambda message: (message.timestamp, message.channel)
        ):
            if self._response_deadline_s is not None and time_s > self._response_deadline_s:
                self._take_sample()
            for message in messages:
                self._read_message(message, time_s)
            if self._response_deadline_s is not None and self.reports.is_complete:
                self._take_sample()

    def _read_message(self, message: can.Message, time_s: float) -> None:
        """Count a message of the log, and process it as the driver would when it arrives on the bus.

        Args:
            message: Frame of the log, or an error that the bus reported.
            time_s: Time of the message in the log.
        """
        self.frames += 1
        if not is_joint_module_frame(message):
            self.other_protocol_frames[guess_frame_origin(message)] += 1
        is_standard_data_frame = not (
            message.is_error_frame or message.is_remote_frame or message.is_extended_id
        )
        if not is_standard_data_frame:
            return
        frame = CanFrame(message.arbitration_id, bytes(message.data))
        opcode = parse_opcode(frame.id)
        if opcode not in FROM_HOST:
            self.reports.process_frame(frame)
        elif opcode == Opcode.SYNC and len(frame.data) == SYNC_BYTES:
            self._begin_sync(frame, time_s)

    def _begin_sync(self, frame: CanFrame, time_s: float) -> None:
        """Begin the tick of a Sync, and end the one before. A Sync is on every bus, and counts once.

        Args:
            frame: The Sync, whose first byte is the lowest 8 bits of its number.
            time_s: Its time in the log.
        """
        count = frame.data[0]
        if count == self.reports.sync & SYNC_COUNT_MASK:  # the same Sync, on another bus
            return
        if self._response_deadline_s is not None:
            self._take_sample()
        sync = self.reports.sync + 1
        self.reports.start_sync(
            sync,
            has_contacts=are_contacts_due(self._schedule, sync),
            has_tail_contact=self._schedule.tail,
        )
        self._response_deadline_s = time_s + self._response_timeout_s

    def _take_sample(self) -> None:
        """Store the joint states of the newest Sync, and count the joints that did not answer it."""
        self.joints.append(to_joint_values(self.reports, self._mounting))
        for joint, module in enumerate(self.reports.modules):
            if module.sync != self.reports.sync:
                self.unanswered_syncs[joint] += 1
        self._response_deadline_s = None


@dataclass(frozen=True)
class ReplayComparison:
    """How far a replay agrees with the run log of the same run."""

    compared: int  # ticks
    first_wrong: str  # the first difference, as text; empty: all values are equal to the bit


def compare_with_run_log(
    replay: LogReplay, layout: RowLayout, rows: dict[str, Floats]
) -> ReplayComparison:
    """Compare the joint states that were replayed from a bus log with those of every tick in the run log.

    Args:
        replay: Replay of the bus log, which has been read.
        layout: Layout of the run log, with the names of the joints.
        rows: Columns of the run log by name: "tick" with shape (n_ticks,), and all QUANTITIES with shape
            (n_ticks, n_joints).

    Returns:
        The number of compared ticks, and the first difference as text, which is empty if there is none.
    """
    recorded = np.stack([rows[name] for name in QUANTITIES], axis=1)  # (n_ticks, 3, n_joints)
    ticks = rows["tick"].astype(int)
    replayed = np.array(replay.joints).reshape(-1, *recorded.shape[1:])  # (n_syncs, 3, n_joints)
    bring_up_syncs, equal_ticks = _find_first_tick(replayed, recorded, ticks)

    syncs = ticks + bring_up_syncs
    is_in_log = syncs < len(replayed)
    compared = int(is_in_log.sum())
    if compared == 0:
        return ReplayComparison(0, "no tick of the record is in the log")
    syncs = syncs[is_in_log]
    ticks = ticks[is_in_log]
    recorded = recorded[is_in_log]
    differences = np.argwhere(replayed[syncs] != recorded)
    if not len(differences):
        return ReplayComparison(compared, "")
    row, value, joint = differences[0]
    recorded_value = recorded[row, value, joint]
    replayed_value = replayed[syncs[row], value, joint]
    return ReplayComparison(
        compared,
        f"tick {ticks[row]}, {layout.joints[joint]}, {QUANTITIES[value]}: {recorded_value:.9g} in the record, "
        f"{replayed_value:.9g} in the log; {compared - equal_ticks} of {compared} ticks differ",
    )


def _find_first_tick(replayed: Floats, recorded: Floats, ticks: np.ndarray) -> tuple[int, int]:
    """Find how many Syncs the bring-up sent before the first tick, by trying all numbers.

    Returns:
        The number of Syncs with which most ticks are equal to the bit, and the number of these ticks.
    """
    max_equal_ticks = -1
    best_syncs = 0
    for bring_up_syncs in range(min(MAX_BRING_UP_SYNCS, len(replayed))):
        is_in_log = ticks + bring_up_syncs < len(replayed)
        is_equal = np.all(
            replayed[ticks[is_in_log] + bring_up_syncs] == recorded[is_in_log], axis=(1, 2)
        )
        equal_ticks = int(is_equal.sum())
        if equal_ticks > max_equal_ticks:
            max_equal_ticks = equal_ticks
            best_syncs = bring_up_syncs
    return best_syncs, max_equal_ticks
