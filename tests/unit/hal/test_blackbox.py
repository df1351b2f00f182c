"""The black box: keeps every tick, and its digest stands for what the motors were told."""

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from snakesim_hal import keys
from snakesim_hal.authority import Decision
from snakesim_hal.backend import Samples, SetPoints
from snakesim_hal.blackbox import BLOCK_ROWS, BlackBox
from snakesim_hal.messages import Contact, Contacts, Mode, Pose
from tests.unit.hal.rig import description, state

ROBOT = description()
STILL = (0.0, 0.0, 0.0)


def decision(target: float = 0.1, mode: Mode = Mode.POSITION, torque_limit: float = 4.0) -> Decision:
    return Decision(SetPoints([mode] * 3, [target] * 3, [torque_limit] * 3), 1, {})


def digest(*rows: tuple[int, Decision], angle: float = 0.0) -> str:
    box = BlackBox(ROBOT)
    for tick, told in rows:
        box.record(tick, tick * 10_000_000, Samples(state(ROBOT, angle)), told)
    return box.command_digest


def contact(obstacle: str | None, force: tuple[float, float, float]) -> Contact:
    return Contact(
        link=1, obstacle=obstacle, position_l=STILL, normal_l=STILL, tangent_1_l=STILL, tangent_2_l=STILL,
        force_l=force, torque_l=STILL,
    )  # fmt: skip


def test_columns_hold_what_was_recorded_however_long_the_run() -> None:
    box = BlackBox(ROBOT)
    count = 9000  # several blocks
    assert count > 3 * BLOCK_ROWS
    for tick in range(count):
        others: dict[str, Any] = {}
        if tick == 2:
            others[keys.POSE] = Pose(
                tick=tick, stamp_ns=0, position_w=(1.0, 2.0, 3.0), orientation_wxyz=(1.0, 0.0, 0.0, 0.0),
                velocity_w=STILL, angular_velocity_w=STILL,
            )  # fmt: skip
        if tick in (3, 6):
            touches = [contact("a", (3.0, 4.0, 0.0)), contact("a", STILL), contact("b", STILL)] if tick == 3 else []
            others[keys.CONTACTS] = Contacts(tick=tick, stamp_ns=0, contacts=touches)
        joints = state(ROBOT, [0.1, 0.2, 0.001 * tick], 2.0, [3.0, 4.0, 5.0])
        box.record(tick, tick * 10_000_000, Samples(joints, others), decision(tick * 1e-4, Mode.TORQUE))
    columns = box.arrays()
    assert box.ticks == count and all(len(column) == count for column in columns.values())
    assert columns["time_s"] == pytest.approx(0.01 * np.arange(count))
    assert columns["angle_rad"][-1].tolist() == pytest.approx([0.1, 0.2, 0.001 * (count - 1)])
    assert columns["velocity_rad_s"][7].tolist() == [2.0] * 3 and columns["torque_nm"][7].tolist() == [3.0, 4.0, 5.0]
    assert columns["target"][4321] == pytest.approx([0.4321] * 3)
    assert columns["torque_limit_nm"][0].tolist() == [4.0] * 3 and set(columns["mode"].flat) == {3}
    assert np.isnan(columns["position_w"][:2]).all()  # unknown until the first pose
    assert columns["position_w"][2:].tolist() == [[1.0, 2.0, 3.0]] * (count - 2)
    assert columns["orientation_wxyz"][5].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert columns["contact_peak_n"][:8].tolist() == [0, 0, 0, 5, 5, 5, 0, 0]
    assert columns["contact_count"][:8].tolist() == [0, 0, 0, 2, 2, 2, 0, 0]


def test_the_digest_stands_for_tick_mode_target_and_torque_limit_and_nothing_else() -> None:
    same = digest((0, decision()), (1, decision()))
    assert digest((0, decision()), (1, decision()), angle=0.5) == same
    others = [
        digest((0, decision())),
        digest((0, decision()), (2, decision())),
        digest((0, decision()), (1, decision(0.1 + 1e-15))),
        digest((0, decision()), (1, decision(mode=Mode.VELOCITY))),
        digest((0, decision()), (1, decision(torque_limit=3.9))),
        digest((1, decision()), (0, decision())),
    ]
    assert len({same, *others}) == 7


def test_a_saved_box_reads_back(tmp_path: Path) -> None:
    box = BlackBox(ROBOT)
    box.record(0, 0, Samples(state(ROBOT, 0.3)), decision())
    box.save(tmp_path / "box.npz")
    with np.load(tmp_path / "box.npz", allow_pickle=False) as archive:
        assert set(archive.files) == set(box.arrays())
        for name, column in box.arrays().items():
            assert np.array_equal(archive[name], column, equal_nan=True), name


def test_a_box_of_a_run_that_never_armed_is_empty(tmp_path: Path) -> None:
    box = BlackBox(ROBOT)
    box.save(tmp_path / "box.npz")
    assert box.ticks == 0 and box.arrays()["angle_rad"].shape == (0, 3)


@pytest.mark.parametrize("count", [0, 1, BLOCK_ROWS, BLOCK_ROWS + 1])
def test_a_block_more_or_less_makes_no_difference(count: int) -> None:
    box = BlackBox(ROBOT)
    for tick in range(count):
        box.record(tick, tick, Samples(state(ROBOT, 0.001 * tick)), decision())
    columns = box.arrays()
    assert columns["angle_rad"][:, 1].tolist() == pytest.approx([0.001 * tick for tick in range(count)])
    assert columns["mode"].shape == (count, 3)


def test_no_tick_pays_for_those_before_it() -> None:
    """A row costs the same after an hour, also the one that needs new space: what is there is never copied."""
    robot = description(chain__modules=100)
    box, row = BlackBox(robot), Samples(state(robot, 0.1))
    told = Decision(SetPoints([Mode.POSITION] * 100, [0.1] * 100, [4.0] * 100), 1, {})
    allocated: list[int] = []
    for tick in range(4 * BLOCK_ROWS + 1):
        tracemalloc.start()
        box.record(tick, tick, row, told)
        allocated.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert max(allocated[BLOCK_ROWS + 1 :]) <= 1.01 * max(allocated[: BLOCK_ROWS + 1])
