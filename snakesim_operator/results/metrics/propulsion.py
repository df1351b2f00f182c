"""Which joint propelled when: one place for summary, report and comparison, so that all of them count alike."""

from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.time_axis import merge_reports


@dataclass(frozen=True)
class Propulsion:
    """A joint propelled for a while."""

    start_s: float
    end_s: float
    joint: int

    @property
    def length_s(self) -> float:
        """How long."""
        return self.end_s - self.start_s


def propulsion_intervals(record: RunRecord) -> list[Propulsion]:
    """Which joint propelled when, in order of time."""
    joints = {joint.name: i for i, joint in enumerate(record.description.joints)}
    bands = merge_reports(record, [state.propulsion_joint for state in record.control])
    return [Propulsion(b.start_s, b.end_s, joints[b.what]) for b in bands if b.what in joints]


def propulsion_periods(record: RunRecord) -> list[Propulsion]:
    """Every time that a joint began to propel after another one, and the first. One that pauses and goes on is none."""
    found: list[Propulsion] = []
    for one in propulsion_intervals(record):
        if not found or found[-1].joint != one.joint:
            found.append(one)
    return found


def count_hand_overs(periods: Sequence[Propulsion]) -> int:
    """How often propulsion passed from one joint to another: one less than there are periods."""
    return max(len(periods) - 1, 0)
