"""When a real robot counts as checked."""

from typing import Any

import msgspec
import pytest

from snakesim_hal.model.checked import (
    PROPERTIES,
    StartCheckRecord,
    compute_mounting_digest,
    find_unchecked_reason,
)
from snakesim_hal.wire.messages import RobotDescription
from snakesim_testing.hal.small_robots import make_description, make_robot_file

JOINTS = make_robot_file().joint_table
CHECKED = StartCheckRecord(
    by="anna",
    on="2026-11-24",
    joints=compute_mounting_digest(JOINTS),
    backend="can",
    hardware="can0",
    confirmed=list(PROPERTIES),
)


def robot(serials: str = "", **fields: Any) -> RobotDescription:
    plain = make_description()
    given = serials.split(",") if serials else [""] * len(plain.joints)
    joints = [
        msgspec.structs.replace(one, serial=serial)
        for one, serial in zip(plain.joints, given, strict=True)
    ]
    return msgspec.structs.replace(
        plain, **{"backend": "can", "hardware": "can0", "joints": joints, **fields}
    )


SERIALS = [f"S{i}" for i in range(len(JOINTS))]


@pytest.mark.parametrize(
    ("checked", "here", "words"),
    [
        (None, robot(emulated=True), ""),
        (None, robot(), "have not been checked"),
        (CHECKED, robot(), ""),
        (
            msgspec.structs.replace(CHECKED, confirmed=["drive", "order", "sign"]),
            robot(),
            "of every joint: gear, zero",
        ),
        (
            CHECKED,
            robot(hardware="can1"),
            "it is on can can1 now, can can0 since anna checked it on 2026-11-24",
        ),
        (CHECKED, robot(",".join(SERIALS)), "joint_1 has drive S0, and had unknown"),
        (
            msgspec.structs.replace(CHECKED, serials=SERIALS),
            robot(",".join(SERIALS), hardware="can1"),
            "",
        ),
        (
            msgspec.structs.replace(CHECKED, serials=SERIALS),
            robot(),
            "joint_1 has drive unknown, and had S0",
        ),
        (
            msgspec.structs.replace(CHECKED, joints="0"),
            robot(),
            "was changed in its file since anna",
        ),
    ],
)
def test_check_counts_only_for_judged_joints_and_drives(
    checked: StartCheckRecord | None, here: RobotDescription, words: str
) -> None:
    found = find_unchecked_reason(checked, JOINTS, here)
    assert words in found if words else found == ""
