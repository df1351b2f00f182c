"""Stores the results of the torque constant trials, and prints the table of all robots in a file.

    python -m verification.torque_constant_results runs/torque-constants.jsonl

The file has one line for each robot, which `torque_constant_trials` appends. The table has one row for each drive type:
how often the joint with the wrong torque constant was reported, and how often another joint was. A list follows of the
robots in which something went wrong.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec

from snakesim_operator.features.evaluate.table import compute_wilson_interval
from verification.recorded_trials import read_results

HEADER = (
    "| drive type | robots | with a wrong constant | named | 95 % interval | with a sound joint reported "
    "| at most (95 %) | joints | unknown | largest error of a value | covered by its interval |"
)


class JointResult(msgspec.Struct, frozen=True, kw_only=True):
    """What the system identification reported of one joint."""

    joint: str
    true_nm_per_a: float  # torque constant of the emulated drive
    value_nm_per_a: float | None  # identified torque constant; None if it is unknown
    half_width_nm_per_a: float | None  # half of its 95 % interval
    is_reported: bool  # whether the torque constant in the robot file was reported as wrong
    reasons: list[str]  # reports about this joint: what is wrong, and why values are unknown

    @property
    def relative_error(self) -> float | None:
        """Error of the identified torque constant, divided by the true one; None if the constant is unknown."""
        if self.value_nm_per_a is None:
            return None
        return self.value_nm_per_a / self.true_nm_per_a - 1

    @property
    def is_covered(self) -> bool:
        """Whether the 95 % interval contains the true torque constant."""
        if self.value_nm_per_a is None or self.half_width_nm_per_a is None:
            return False
        return abs(self.value_nm_per_a - self.true_nm_per_a) <= self.half_width_nm_per_a


class TorqueConstantResult(msgspec.Struct, frozen=True, kw_only=True):
    """What the system identification reported of one robot."""

    backend: str
    number: int  # of the robot, which is its seed
    file_nm_per_a: float  # torque constant of all joints in the robot file
    faulty_joint: str | None  # joint whose drive has another torque constant; None without a fault
    joints: list[JointResult]  # tail to head
    refusal: str = ""  # why the run did not begin; empty if it did

    @property
    def is_named(self) -> bool:
        """Whether the torque constant of the joint with the fault was reported as wrong."""
        return any(joint.is_reported for joint in self.joints if joint.joint == self.faulty_joint)

    @property
    def falsely_reported(self) -> list[str]:
        """Joints whose torque constant is right, and that were reported as wrong."""
        return [
            joint.joint
            for joint in self.joints
            if joint.is_reported and joint.joint != self.faulty_joint
        ]

    @property
    def unknown(self) -> list[str]:
        """Joints whose torque constant is unknown."""
        return [joint.joint for joint in self.joints if joint.value_nm_per_a is None]


def format_table(results: Sequence[TorqueConstantResult]) -> Iterator[str]:
    """Yield the table of drive types as lines of Markdown."""
    yield HEADER
    yield "|" + "---|" * HEADER.count(" |")
    backends = list(dict.fromkeys(result.backend for result in results))
    for backend in backends:
        yield _format_row(backend, [r for r in results if r.backend == backend])
    if len(backends) > 1:
        yield _format_row("all", results)


def _format_row(label: str, results: Sequence[TorqueConstantResult]) -> str:
    faulty = [result for result in results if result.faulty_joint is not None]
    named_count = sum(result.is_named for result in faulty)
    low, high = compute_wilson_interval(named_count, len(faulty))
    false_alarm_count = sum(bool(result.falsely_reported) for result in results)
    max_false_alarms = compute_wilson_interval(false_alarm_count, len(results))[1]
    joints = [joint for result in results for joint in result.joints]
    errors = [abs(joint.relative_error) for joint in joints if joint.relative_error is not None]
    max_error = f"{100 * max(errors):.1f} %" if errors else "-"
    covered_count = sum(joint.is_covered for joint in joints)
    return (
        f"| {label} | {len(results)} | {len(faulty)} | {named_count} | {100 * low:.0f} to {100 * high:.0f} % "
        f"| {false_alarm_count} | {100 * max_false_alarms:.0f} % | {len(joints)} | {len(joints) - len(errors)} "
        f"| {max_error} | {covered_count} of {len(errors)} |"
    )


def format_failures(results: Sequence[TorqueConstantResult]) -> Iterator[str]:
    """Yield a line for each robot with a missed fault, a false alarm or an unknown torque constant."""
    for result in results:
        is_missed = result.faulty_joint is not None and not result.is_named
        if not (is_missed or result.falsely_reported or result.unknown):
            continue
        reasons = [
            f"{joint.joint}: {'; '.join(joint.reasons)}" for joint in result.joints if joint.reasons
        ]
        yield (
            f"{result.backend} {result.number}: wrong constant in {result.faulty_joint or 'no joint'}, "
            f"reported falsely {result.falsely_reported}, unknown {result.unknown}; {result.refusal or reasons}"
        )


def main() -> int:
    """Print the table and the failures of a results file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("path", type=Path)
    results = read_results(parser.parse_args().path, TorqueConstantResult)
    print("\n".join(format_table(results)))
    print("\n".join(format_failures(results)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
