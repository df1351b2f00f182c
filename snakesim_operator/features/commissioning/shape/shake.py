"""Asks a person to shake every link, because drawn shapes do not show whether a gear is loose.

The motors stay off. Within backlash, a person can move a link while the drive behind it rests.
"""

from collections.abc import Mapping, Sequence
from typing import Literal

from snakesim_hal.base.terminal import print_line
from snakesim_operator.features.commissioning.by_hand import HandMovedRobot, read_typed_line

ShakeResult = Literal["tight", "loose", "unknown"]
RESULT_BY_ANSWER: Mapping[str, ShakeResult] = {"no": "tight", "yes": "loose", "unknown": "unknown"}
ANSWERS = "no, yes or unknown"


def ask_to_shake_links(robot: HandMovedRobot) -> dict[str, ShakeResult]:
    """Ask the person to shake the link in front of each joint, and return what they found, by the joint's name.

    Raises:
        RefusedError: The robot is armed or sends no angles, or the terminal is gone.
    """
    print_line(
        "Drawn shapes do not show backlash. For each joint, hold the link behind it, and shake the link in front of it."
    )
    results: dict[str, ShakeResult] = {}
    for joint in robot.joints:
        print_line(
            f"{joint.name}: does the link in front of it move before its drive does? Type {ANSWERS}, and press Enter."
        )
        results[joint.name] = _read_result(robot)
    return results


def _read_result(robot: HandMovedRobot) -> ShakeResult:
    """Return the person's answer; ask again while it is none of the allowed ones."""
    answers: list[ShakeResult] = []

    def is_answered() -> bool:
        text = read_typed_line()
        if text is None:
            return False
        result = RESULT_BY_ANSWER.get(text.lower())
        if result is None:
            print_line(f"  type {ANSWERS}, and press Enter")
            return False
        answers.append(result)
        return True

    for _ in robot.read_angles_rad(is_answered):
        pass  # reading continues until the answer, and ends with an error if the robot is armed
    return answers[0]


def format_shake_results(results: Mapping[str, ShakeResult]) -> list[str]:
    """Return a line for the joints that are loose, one for those that are unknown, and one if all are tight."""
    loose = list_joints(results, "loose")
    unknown = list_joints(results, "unknown")
    lines: list[str] = []
    if loose:
        lines.append(
            f"gear of {', '.join(loose)} wrong: the link moves before its drive; repair it"
        )
    if unknown:
        lines.append(
            f"gear of {', '.join(unknown)} unknown: you do not know whether the link moves before its drive"
        )
    if not lines:
        lines.append("no link moves before its drive does")
    return lines


def list_joints(results: Mapping[str, ShakeResult], wanted: ShakeResult) -> Sequence[str]:
    """Return the names of the joints with a result."""
    return [name for name, result in results.items() if result == wanted]
