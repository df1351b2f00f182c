"""Bus time: the worst case is never too little, and what is refused is told with ways out that work."""

import re
from itertools import pairwise
from typing import Any

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from snakesim_can_backend.bus.load import (
    MAX_LOAD,
    MAX_SYNCS_PER_REPORT,
    ReportSchedule,
    compute_bus_load,
    compute_busiest_period_s,
    compute_max_frame_bits,
    compute_syncs_per_report,
    count_joints_per_bus,
    find_max_rate_hz,
    list_streams,
    plan_reports,
    validate_bus_load,
)
from snakesim_can_backend.protocol.definitions import LAST_NODE, Opcode
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.scenario import load_scenario as load_scenario
from snakesim_testing.messages import raises_error

TRIPLET = load_scenario("triplet").config
WORST_OF_8 = 135


def run_of(joints: int, rate_hz: float = 100.0) -> RunConfig:
    chain = msgspec.structs.replace(TRIPLET.robot.chain, modules=joints)
    robot = msgspec.structs.replace(TRIPLET.robot, chain=chain)
    return msgspec.structs.replace(TRIPLET, robot=robot, rate_hz=rate_hz)


def channels(count: int) -> list[str]:
    return [f"can{i}" for i in range(count)]


# --- one frame ---------------------------------------------------------------------------------------------


def bits_of(identifier: int, data: bytes) -> list[int]:
    """What is sent from start of frame to the end of the CRC, before stuffing (ISO 11898-1, base format)."""
    text = f"0{identifier:011b}000{len(data):04b}" + "".join(f"{byte:08b}" for byte in data)
    bits = [int(bit) for bit in text]
    crc = 0
    for bit in bits:
        crc = (crc << 1 ^ (0x4599 if bit ^ crc >> 14 else 0)) & 0x7FFF
    return [*bits, *(crc >> i & 1 for i in range(14, -1, -1))]


def stuffed(bits: list[int]) -> list[int]:
    """After five equal bits comes one of the other kind, which counts towards the next five."""
    out: list[int] = []
    run = 0
    for bit in bits:
        run = run + 1 if out and bit == out[-1] else 1
        out.append(bit)
        if run == 5:
            out.append(1 - bit)
            run = 1
    return out


def frame_bits(identifier: int, data: bytes) -> int:
    delimiters_acknowledge_end_and_gap = 1 + 1 + 1 + 7 + 3
    return len(stuffed(bits_of(identifier, data))) + delimiters_acknowledge_end_and_gap


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
@example(0, bytes(8))
@example(0x7FF, b"\xff" * 8)
@example(0x078, b"\x3c\x3c\x3c\x3c\x3c\x3c\x3c\x3c")
@example(0x078, b"\x87\x87\x87\x87\x87\x87\x87\x87")
@example(0x787, b"\x0f\x0f\x0f\x0f\x0f\x0f\x0f\x0f")
def test_no_frame_is_ever_longer_than_the_worst_case(identifier: int, data: bytes) -> None:
    assert 47 + 8 * len(data) <= frame_bits(identifier, data) <= compute_max_frame_bits(len(data))


def test_bus_load_worst_case_is_nearly_reached() -> None:
    frames = [
        (i, bytes([b]) * 8)
        for i in range(0, 0x800, 8)
        for b in (0, 255, 0x0F, 0xF0, 0x87, 0x78, 0x3C, 0xC3)
    ]
    assert max(frame_bits(*frame) for frame in frames) >= WORST_OF_8 - 4


# --- the sum -----------------------------------------------------------------------------------------------


def test_bus_load_of_absent_reports_is_zero() -> None:
    kinds = {s.opcode for s in list_streams(13, ReportSchedule(100.0, 0, 0)) if s.frames_per_s}
    assert kinds == {
        Opcode.SYNC,
        Opcode.SET_POINT,
        Opcode.JOINT_STATE,
        Opcode.HEARTBEAT,
        Opcode.HEALTH,
    }
    without_tail = compute_bus_load(13, ReportSchedule(100.0, tail=False))
    assert compute_bus_load(13, ReportSchedule(100.0)) - without_tail == pytest.approx(
        100 * 135 / 1e6
    )


def test_the_busiest_period_is_one_with_forces() -> None:
    expected_us = 105 + 13 * (115 + 135 + 135) + 135
    for contact_every in (1, 2, 7):
        assert compute_busiest_period_s(13, ReportSchedule(100.0, contact_every)) == pytest.approx(
            expected_us * 1e-6
        )
    assert compute_busiest_period_s(13, ReportSchedule(100.0, 0)) == pytest.approx(
        (105 + 13 * (115 + 135)) * 1e-6
    )


@given(st.floats(20, 5000), st.floats(0.001, 1e4))
def test_reports_come_as_nearly_as_wanted_as_whole_syncs_allow(
    rate_hz: float, wanted_hz: float
) -> None:
    apart = compute_syncs_per_report(rate_hz, wanted_hz)
    assert 1 <= apart <= MAX_SYNCS_PER_REPORT
    if 1 < apart < MAX_SYNCS_PER_REPORT:
        assert abs(rate_hz / wanted_hz - apart) <= 0.5
    assert compute_syncs_per_report(rate_hz, 0.0) == 0


def test_reports_are_those_of_the_robot_and_of_the_settings() -> None:
    assert plan_reports(run_of(13), CanSettings()) == ReportSchedule(100.0, 1, 20)
    assert plan_reports(
        run_of(13, 200.0), CanSettings(contact_rate_hz=50.0, imu_rate_hz=0.0)
    ) == ReportSchedule(200.0, 4, 0)
    blind = msgspec.structs.replace(
        TRIPLET.robot,
        sensors=msgspec.structs.replace(TRIPLET.robot.sensors, contacts=None, imu=None),
    )
    assert plan_reports(
        msgspec.structs.replace(TRIPLET, robot=blind), CanSettings()
    ) == ReportSchedule(100.0, 0, 0)


# --- shares ------------------------------------------------------------------------------------------------


@given(st.integers(1, LAST_NODE), st.integers(0, 8))
def test_joints_are_shared_out_evenly_tail_first(joints: int, buses: int) -> None:
    if buses > joints:
        return
    found = count_joints_per_bus(run_of(joints), CanSettings(channels=channels(buses)))
    assert sum(found) == joints
    assert len(found) == max(buses, 1)
    assert max(found) - min(found) <= 1
    assert found == sorted(found, reverse=True)


def test_given_shares_are_kept() -> None:
    assert count_joints_per_bus(
        run_of(13), CanSettings(channels=channels(2), joints_per_channel=[3, 10])
    ) == [3, 10]


@pytest.mark.parametrize(
    ("joints", "settings"),
    [
        (13, CanSettings(channels=["can0", "can0"])),
        (63, CanSettings()),
        (13, CanSettings(channels=channels(2), joints_per_channel=[13])),
        (13, CanSettings(channels=channels(2), joints_per_channel=[6, 6])),
        (2, CanSettings(channels=channels(3))),
    ],
)
def test_shares_that_cannot_be_are_refused(joints: int, settings: CanSettings) -> None:
    with raises_error(ConfigError, code=("bus/invalid-channel", "drive/unsupported-setting")):
        count_joints_per_bus(run_of(joints), settings)


# --- refusal -----------------------------------------------------------------------------------------------


def refusal(config: RunConfig, settings: CanSettings) -> str | None:
    try:
        validate_bus_load(config, settings)
    except ConfigError as error:
        return str(error)
    return None


def ways_out(
    text: str, config: RunConfig, settings: CanSettings
) -> list[tuple[RunConfig, CanSettings]]:
    """The configurations that a refusal suggests."""
    advice = text.rpartition("What would fit: ")[2].rstrip(".")
    if advice == "nothing on classic CAN":
        return []
    found = []
    for way in advice.split("; or "):
        changes: dict[str, Any] = {}
        if rate := re.fullmatch(r"rate_hz = (\d+) on (\d+) bus(?:es)?", way):
            assert int(rate[2]) == max(len(settings.channels), 1)
            found.append((msgspec.structs.replace(config, rate_hz=float(rate[1])), settings))
            continue
        if more := re.fullmatch(r"(\d+) channels with up to (\d+) joints each", way):
            changes = {"channels": channels(int(more[1])), "joints_per_channel": []}
            assert max(
                count_joints_per_bus(config, CanSettings(channels=channels(int(more[1]))))
            ) == int(more[2])
        elif fewer := re.fullmatch(r"backends\.can\.contact_rate_hz = (\S+)", way):
            changes = {"contact_rate_hz": float(fewer[1])}
        assert changes, way
        found.append((config, msgspec.structs.replace(settings, **changes)))
    return found


def test_fewer_forces_are_suggested_when_that_is_enough() -> None:
    config, settings = run_of(13, 190.0), CanSettings(contact_rate_hz=190.0)
    text = refusal(config, settings)
    assert text is not None
    assert "backends.can.contact_rate_hz = 47.5" in text


@given(
    joints=st.integers(1, LAST_NODE),
    rate_hz=st.floats(20, 2000),
    contact_hz=st.none() | st.floats(0, 2000),
    imu_hz=st.floats(0, 200),  # down to 5e-324: hardly ever is not a division by nothing
    buses=st.integers(0, 4),
    data=st.data(),
)
def test_bus_load_suggestions_all_fit(
    joints: int,
    rate_hz: float,
    contact_hz: float | None,
    imu_hz: float,
    buses: int,
    data: st.DataObject,
) -> None:
    buses = min(buses, joints)
    split: list[int] = []
    if buses > 1 and data.draw(st.booleans()):
        cuts = data.draw(
            st.lists(
                st.integers(1, joints - 1), min_size=buses - 1, max_size=buses - 1, unique=True
            )
        )
        ends = [0, *sorted(cuts), joints]
        split = [b - a for a, b in pairwise(ends)]
    settings = CanSettings(
        channels=channels(buses),
        joints_per_channel=split,
        contact_rate_hz=contact_hz,
        imu_rate_hz=imu_hz,
    )
    config = run_of(joints, rate_hz)
    text = refusal(config, settings)
    if text is None:
        assert all(share <= MAX_LOAD for share in validate_bus_load(config, settings))
        return
    for way in ways_out(text, config, settings):
        assert refusal(*way) is None


def test_the_rate_that_is_suggested_is_the_highest_whole_one() -> None:
    config, settings = run_of(18, 200.0), CanSettings()
    best = find_max_rate_hz(18, config, settings)
    assert best is not None
    for rate in range(best + 1, 201):
        assert refusal(run_of(18, float(rate)), settings) is not None
    assert find_max_rate_hz(LAST_NODE, run_of(LAST_NODE, 21.0), CanSettings(imu_rate_hz=5.0)) in (
        None,
        20,
    )


def test_bus_load_beyond_all_settings_suggests_a_lower_rate() -> None:
    text = refusal(run_of(LAST_NODE, 5000.0), CanSettings(channels=channels(8)))
    assert text is not None
    assert "rate_hz = " in text  # slower always helps
    assert "channels with" not in text
    assert "contact_rate_hz" not in text
