"""A log of the bus through the driver's own reading of it, without a bus: the joint states of every tick.

A tick begins at its Sync. Its sample is taken when all awaited modules have answered, or when they would no longer have
been waited for. Frames that were received together have one time in the log, and are read together here.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import groupby

import can
import numpy as np

from snakesim_can_backend.bus.load import ReportSchedule
from snakesim_can_backend.bus.unknown_frames import guess_origin, matches_protocol
from snakesim_can_backend.driver.reports import ModuleReports
from snakesim_can_backend.driver.sensors import contacts_due, joint_values
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import FROM_HOST, Frame, Opcode, parse_opcode
from snakesim_drivers.mounting import Mounting
from snakesim_hal.base.arrays import Floats
from snakesim_hal.run_log.black_box import Layout

SYNC_BYTES = load_layouts()[Opcode.SYNC].length
BRING_UP_SYNCS = 64  # before the first tick, at most
VALUES = ("angle_rad", "velocity_rad_s", "torque_nm")


class LogReplay:
    """A log, read frame by frame as the driver reads a bus."""

    def __init__(self, mounting: Mounting, reports: ReportSchedule, answer_limit_s: float) -> None:
        """answer_limit_s: how long the driver waits for the answers to a Sync."""
        self._mounting = mounting
        self.reading = ModuleReports(len(mounting.sign))
        self.frames = 0
        self.foreign: Counter[str] = Counter()  # frames that are none of the protocol, by whose they look like
        self.joints: list[Floats] = []  # by Sync: angle, velocity and torque, (3, n_joints)
        self.silent = [0] * len(mounting.sign)  # Syncs that a joint did not answer in time
        self._reports, self._answer_limit_s = reports, answer_limit_s
        self._open_until_s: float | None = None  # of the newest Sync, whose sample is not taken yet

    def read(self, log: Iterable[can.Message]) -> None:
        """Read a whole log."""
        for (time_s, _), together in groupby(log, key=lambda message: (message.timestamp, message.channel)):
            if self._open_until_s is not None and time_s > self._open_until_s:
                self._sample()
            for message in together:
                self.frames += 1
                self.foreign[guess_origin(message)] += not matches_protocol(message)
                if not (message.is_error_frame or message.is_remote_frame or message.is_extended_id):
                    self._take(Frame(message.arbitration_id, bytes(message.data)), time_s)
            if self._open_until_s is not None and self.reading.complete:
                self._sample()
        # The log may end in the middle of a tick: what is missing of the last Sync's answers is not known.

    def _take(self, frame: Frame, time_s: float) -> None:
        opcode = parse_opcode(frame.id)
        if opcode not in FROM_HOST:
            self.reading.process_frame(frame)
            return
        if opcode != Opcode.SYNC or len(frame.data) != SYNC_BYTES:
            return
        if frame.data[0] == self.reading.sync & 0xFF:  # the same Sync, on another bus
            return
        if self._open_until_s is not None:
            self._sample()
        number = self.reading.sync + 1
        self.reading.begin_sync(number, contacts=contacts_due(self._reports, number), tail=self._reports.tail)
        self._open_until_s = time_s + self._answer_limit_s

    def _sample(self) -> None:
        self.joints.append(joint_values(self.reading, self._mounting))
        for joint, module in enumerate(self.reading.modules):
            self.silent[joint] += module.sync != self.reading.sync
        self._open_until_s = None


@dataclass(frozen=True)
class ReplayComparison:
    """A replay held against a record of the same run."""

    compared: int  # ticks
    first_wrong: str  # empty: all are equal to the bit


def compare_with_run_log(done: LogReplay, layout: Layout, rows: dict[str, Floats]) -> ReplayComparison:
    """Compare the joint states of every tick. The Syncs of the bring-up, before the first tick, are found by trying."""
    recorded = np.stack([rows[name] for name in VALUES], axis=1)  # (ticks, 3, n_joints)
    ticks = rows["tick"].astype(int)
    found = np.array(done.joints).reshape(-1, *recorded.shape[1:])
    most, best = -1, 0
    for before in range(min(BRING_UP_SYNCS, len(found))):
        known = ticks + before < len(found)
        equal = int(np.all(found[ticks[known] + before] == recorded[known], axis=(1, 2)).sum())
        if equal > most:
            most, best = equal, before
    known = ticks + best < len(found)
    wrong = np.argwhere(found[ticks[known] + best] != recorded[known])
    if not known.any():
        return ReplayComparison(0, "no tick of the record is in the log")
    if not len(wrong):
        return ReplayComparison(int(known.sum()), "")
    row, value, joint = wrong[0]
    was, now = recorded[known][row, value, joint], found[ticks[known][row] + best, value, joint]
    return ReplayComparison(
        int(known.sum()),
        f"tick {ticks[known][row]}, {layout.joints[joint]}, {VALUES[value]}: {was:.9g} in the record, "
        f"{now:.9g} in the log; {known.sum() - most} of {known.sum()} ticks differ",
    )
