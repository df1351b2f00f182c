"""A start check counts only for the joints, drives and bus that were checked."""

from typing import Any

import msgspec
import pytest

from snakesim_hal.model.robot_file.checked import (
    PROPERTIES,
    StartCheckRecord,
    compute_mounting_digest,
    find_unchecked_reason,
)
from snakesim_hal.wire.messages import RobotDescription
from snakesim_testing.hal.small_robots import make_description, make_robot_file

JOINTS = make_robot_file().joint_table
RECORD = StartCheckRecord(
    by="anna",
    on="2026-11-24",
    joints=compute_mounting_digest(JOINTS),
    backend="can",
    hardware="can0",
    confirmed=list(PROPERTIES),
)


def describe_can_robot(serials: str = "", **fields: Any) -> RobotDescription:
    """Return the description of a robot on can0, with these serial numbers of its drives."""
    description = make_description()
    serial_list = serials.split(",") if serials else [""] * len(description.joints)
    joints = [
        msgspec.structs.replace(joint, serial=serial)
        for joint, serial in zip(description.joints, serial_list, strict=True)
    ]
    return msgspec.structs.replace(
        description, **{"backend": "can", "hardware": "can0", "joints": joints, **fields}
    )


SERIALS = [f"S{i}" for i in range(len(JOINTS))]


@pytest.mark.parametrize(
    ("record", "description", "expected_text"),
    [
        (None, describe_can_robot(emulated=True), ""),
        (None, describe_can_robot(), "have not been checked"),
        (RECORD, describe_can_robot(), ""),
        (
            msgspec.structs.replace(RECORD, confirmed=["drive", "order", "sign"]),
            describe_can_robot(),
            "of every joint: gear, zero",
        ),
        (
            RECORD,
            describe_can_robot(hardware="can1"),
            "it is on can can1 now, can can0 since anna checked it on 2026-11-24",
        ),
        (RECORD, describe_can_robot(",".join(SERIALS)), "joint_1 has drive S0, and had unknown"),
        (
            msgspec.structs.replace(RECORD, serials=SERIALS),
            describe_can_robot(",".join(SERIALS), hardware="can1"),
            "",
        ),
        (
            msgspec.structs.replace(RECORD, serials=SERIALS),
            describe_can_robot(),
            "joint_1 has drive unknown, and had S0",
        ),
        (
            msgspec.structs.replace(RECORD, joints="0"),
            describe_can_robot(),
            "was changed in its file since anna",
        ),
    ],
)
def test_start_check_counts_only_for_checked_joints_and_drives(
    record: StartCheckRecord | None, description: RobotDescription, expected_text: str
) -> None:
    reason = find_unchecked_reason(record, JOINTS, description)
    if expected_text:
        assert expected_text in reason
    else:
        assert reason == ""
