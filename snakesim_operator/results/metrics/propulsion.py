"""Finds which joint propelled when. Summary, report and comparison all use this module, so that they count alike."""

from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.time_axis import merge_equal_reports


@dataclass(frozen=True)
class PropulsionInterval:
    """An interval in which one joint propelled, on the time axis of the run."""

    start_s: float
    end_s: float
    joint_index: int  # index, tail to head

    @property
    def duration_s(self) -> float:
        """Duration in s."""
        return self.end_s - self.start_s


def find_propulsion_intervals(record: RunRecord) -> list[PropulsionInterval]:
    """Return the intervals in which control reported a propulsion joint, in time order."""
    joint_index_by_name = {joint.name: i for i, joint in enumerate(record.description.joints)}
    names = [state.propulsion_joint for state in record.control_states]
    intervals: list[PropulsionInterval] = []
    for band in merge_equal_reports(record, names):
        if band.label in joint_index_by_name:
            intervals.append(
                PropulsionInterval(band.start_s, band.end_s, joint_index_by_name[band.label])
            )
    return intervals


def find_propulsion_periods(record: RunRecord) -> list[PropulsionInterval]:
    """Return the first interval of each period in which one joint propelled, in time order.

    A joint that pauses and continues, with no other joint in between, has one period.
    """
    periods: list[PropulsionInterval] = []
    for interval in find_propulsion_intervals(record):
        if not periods or periods[-1].joint_index != interval.joint_index:
            periods.append(interval)
    return periods


def count_hand_overs(periods: Sequence[PropulsionInterval]) -> int:
    """Return how often propulsion passed from one joint to another: one less than there are periods."""
    return max(len(periods) - 1, 0)
