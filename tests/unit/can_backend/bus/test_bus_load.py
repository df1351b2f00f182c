"""Bus load: the computed worst case is an upper bound, and a refusal suggests configurations that fit."""

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
# Longest frames, in us at 1 Mbit/s, which is one bit per us.
SYNC_US = 105
SETPOINT_US = 115
JOINT_STATE_US = 135
CONTACT_US = 135
MAX_BITS_OF_8_BYTES = 135  # bits of a frame with 8 bytes, with all stuff bits that are possible


def make_run_with_joints(joints: int, rate_hz: float = 100.0) -> RunConfig:
    """Return the configuration of a run with this number of joints."""
    chain = msgspec.structs.replace(TRIPLET.robot.chain, modules=joints)
    robot = msgspec.structs.replace(TRIPLET.robot, chain=chain)
    return msgspec.structs.replace(TRIPLET, robot=robot, rate_hz=rate_hz)


def name_channels(count: int) -> list[str]:
    """Return the names of some channels."""
    return [f"can{i}" for i in range(count)]


# --- one frame ---------------------------------------------------------------------------------------------


def encode_frame_bits(identifier: int, data: bytes) -> list[int]:
    """Return the bits from start of frame to the end of the CRC, before stuffing (ISO 11898-1, base format)."""
    text = f"0{identifier:011b}000{len(data):04b}" + "".join(f"{byte:08b}" for byte in data)
    bits = [int(bit) for bit in text]
    crc = 0
    for bit in bits:
        crc = (crc << 1 ^ (0x4599 if bit ^ crc >> 14 else 0)) & 0x7FFF
    return [*bits, *(crc >> i & 1 for i in range(14, -1, -1))]


def add_stuff_bits(bits: list[int]) -> list[int]:
    """Insert the opposite bit after five equal bits. An inserted bit counts towards the next five."""
    stuffed_bits: list[int] = []
    equal_bit_count = 0
    for bit in bits:
        equal_bit_count = equal_bit_count + 1 if stuffed_bits and bit == stuffed_bits[-1] else 1
        stuffed_bits.append(bit)
        if equal_bit_count == 5:
            stuffed_bits.append(1 - bit)
            equal_bit_count = 1
    return stuffed_bits


def count_frame_bits(identifier: int, data: bytes) -> int:
    """Return the length of a whole frame on the bus, with its stuff bits and the gap after it."""
    delimiters_acknowledge_end_and_gap = 1 + 1 + 1 + 7 + 3
    return (
        len(add_stuff_bits(encode_frame_bits(identifier, data)))
        + delimiters_acknowledge_end_and_gap
    )


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
@example(0, bytes(8))
@example(0x7FF, b"\xff" * 8)
@example(0x078, b"\x3c\x3c\x3c\x3c\x3c\x3c\x3c\x3c")
@example(0x078, b"\x87\x87\x87\x87\x87\x87\x87\x87")
@example(0x787, b"\x0f\x0f\x0f\x0f\x0f\x0f\x0f\x0f")
def test_max_frame_bits_of_any_frame_is_an_upper_bound(identifier: int, data: bytes) -> None:
    assert (
        47 + 8 * len(data)
        <= count_frame_bits(identifier, data)
        <= compute_max_frame_bits(len(data))
    )


def test_bus_load_worst_case_is_nearly_reached() -> None:
    frames = [
        (identifier, bytes([byte]) * 8)
        for identifier in range(0, 0x800, 8)
        for byte in (0, 255, 0x0F, 0xF0, 0x87, 0x78, 0x3C, 0xC3)
    ]
    assert max(count_frame_bits(*frame) for frame in frames) >= MAX_BITS_OF_8_BYTES - 4


# --- load of a bus -----------------------------------------------------------------------------------------


def test_bus_load_of_absent_reports_is_zero() -> None:
    sent_opcodes = {
        stream.opcode
        for stream in list_streams(13, ReportSchedule(100.0, 0, 0))
        if stream.frames_per_s
    }
    assert sent_opcodes == {
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


def test_busiest_period_of_a_bus_includes_contact_reports() -> None:
    expected_us = SYNC_US + 13 * (SETPOINT_US + JOINT_STATE_US + CONTACT_US) + CONTACT_US
    for contact_every in (1, 2, 7):
        assert compute_busiest_period_s(13, ReportSchedule(100.0, contact_every)) == pytest.approx(
            expected_us * 1e-6
        )
    assert compute_busiest_period_s(13, ReportSchedule(100.0, 0)) == pytest.approx(
        (SYNC_US + 13 * (SETPOINT_US + JOINT_STATE_US)) * 1e-6
    )


@given(st.floats(20, 5000), st.floats(0.001, 1e4))
def test_syncs_per_report_is_nearest_whole_number_to_requested_rate(
    rate_hz: float, requested_hz: float
) -> None:
    syncs_per_report = compute_syncs_per_report(rate_hz, requested_hz)
    assert 1 <= syncs_per_report <= MAX_SYNCS_PER_REPORT
    if 1 < syncs_per_report < MAX_SYNCS_PER_REPORT:
        assert abs(rate_hz / requested_hz - syncs_per_report) <= 0.5
    assert compute_syncs_per_report(rate_hz, 0.0) == 0


def test_report_plan_follows_sensors_of_robot_and_settings() -> None:
    assert plan_reports(make_run_with_joints(13), CanSettings()) == ReportSchedule(100.0, 1, 20)
    assert plan_reports(
        make_run_with_joints(13, 200.0), CanSettings(contact_rate_hz=50.0, imu_rate_hz=0.0)
    ) == ReportSchedule(200.0, 4, 0)
    robot_without_sensors = msgspec.structs.replace(
        TRIPLET.robot,
        sensors=msgspec.structs.replace(TRIPLET.robot.sensors, contacts=None, imu=None),
    )
    assert plan_reports(
        msgspec.structs.replace(TRIPLET, robot=robot_without_sensors), CanSettings()
    ) == ReportSchedule(100.0, 0, 0)


# --- joints per bus ----------------------------------------------------------------------------------------


@given(st.integers(1, LAST_NODE), st.integers(0, 8))
def test_joints_per_bus_are_even_with_more_at_the_tail(joints: int, buses: int) -> None:
    if buses > joints:
        return
    joints_per_bus = count_joints_per_bus(
        make_run_with_joints(joints), CanSettings(channels=name_channels(buses))
    )
    assert sum(joints_per_bus) == joints
    assert len(joints_per_bus) == max(buses, 1)
    assert max(joints_per_bus) - min(joints_per_bus) <= 1
    assert joints_per_bus == sorted(joints_per_bus, reverse=True)


def test_joints_per_bus_from_settings_are_kept() -> None:
    assert count_joints_per_bus(
        make_run_with_joints(13), CanSettings(channels=name_channels(2), joints_per_channel=[3, 10])
    ) == [3, 10]


@pytest.mark.parametrize(
    ("joints", "settings"),
    [
        (13, CanSettings(channels=["can0", "can0"])),
        (63, CanSettings()),
        (13, CanSettings(channels=name_channels(2), joints_per_channel=[13])),
        (13, CanSettings(channels=name_channels(2), joints_per_channel=[6, 6])),
        (2, CanSettings(channels=name_channels(3))),
    ],
)
def test_joints_per_bus_that_do_not_fit_are_refused(joints: int, settings: CanSettings) -> None:
    with raises_error(ConfigError, code=("bus/invalid-channel", "drive/unsupported-setting")):
        count_joints_per_bus(make_run_with_joints(joints), settings)


# --- refusals ----------------------------------------------------------------------------------------------


def find_refusal(config: RunConfig, settings: CanSettings) -> str | None:
    """Return the message that refuses a configuration, or None if it fits."""
    try:
        validate_bus_load(config, settings)
    except ConfigError as error:
        return str(error)
    return None


def list_suggested_configurations(
    text: str, config: RunConfig, settings: CanSettings
) -> list[tuple[RunConfig, CanSettings]]:
    """Return the configurations that a refusal suggests."""
    advice = text.rpartition("What would fit: ")[2].rstrip(".")
    if advice == "nothing on classic CAN":
        return []
    configurations = []
    for suggestion in advice.split("; or "):
        changes: dict[str, Any] = {}
        if bus_rate := re.fullmatch(r"rate_hz = (\d+) on (\d+) bus(?:es)?", suggestion):
            assert int(bus_rate[2]) == max(len(settings.channels), 1)
            configurations.append(
                (msgspec.structs.replace(config, rate_hz=float(bus_rate[1])), settings)
            )
            continue
        if channel_counts := re.fullmatch(
            r"(\d+) channels with up to (\d+) joints each", suggestion
        ):
            changes = {"channels": name_channels(int(channel_counts[1])), "joints_per_channel": []}
            assert max(
                count_joints_per_bus(
                    config, CanSettings(channels=name_channels(int(channel_counts[1])))
                )
            ) == int(channel_counts[2])
        elif contact_rate := re.fullmatch(r"backends\.can\.contact_rate_hz = (\S+)", suggestion):
            changes = {"contact_rate_hz": float(contact_rate[1])}
        assert changes, suggestion
        configurations.append((config, msgspec.structs.replace(settings, **changes)))
    return configurations


def test_bus_load_refusal_suggests_fewer_contact_reports_when_enough() -> None:
    config = make_run_with_joints(13, 190.0)
    settings = CanSettings(contact_rate_hz=190.0)
    text = find_refusal(config, settings)
    assert text is not None
    assert "backends.can.contact_rate_hz = 47.5" in text


@given(
    joints=st.integers(1, LAST_NODE),
    rate_hz=st.floats(20, 2000),
    contact_hz=st.none() | st.floats(0, 2000),
    imu_hz=st.floats(0, 200),  # down to 5e-324: a tiny rate must not divide by zero
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
    joints_per_channel: list[int] = []
    if buses > 1 and data.draw(st.booleans()):
        boundaries = data.draw(
            st.lists(
                st.integers(1, joints - 1), min_size=buses - 1, max_size=buses - 1, unique=True
            )
        )
        ends = [0, *sorted(boundaries), joints]
        joints_per_channel = [end - start for start, end in pairwise(ends)]
    settings = CanSettings(
        channels=name_channels(buses),
        joints_per_channel=joints_per_channel,
        contact_rate_hz=contact_hz,
        imu_rate_hz=imu_hz,
    )
    config = make_run_with_joints(joints, rate_hz)
    text = find_refusal(config, settings)
    if text is None:
        assert all(load <= MAX_LOAD for load in validate_bus_load(config, settings))
        return
    for suggested in list_suggested_configurations(text, config, settings):
        assert find_refusal(*suggested) is None


def test_suggested_rate_is_the_highest_whole_rate_that_fits() -> None:
    config = make_run_with_joints(18, 200.0)
    settings = CanSettings()
    suggested_rate_hz = find_max_rate_hz(18, config, settings)
    assert suggested_rate_hz is not None
    for rate_hz in range(suggested_rate_hz + 1, 201):
        assert find_refusal(make_run_with_joints(18, float(rate_hz)), settings) is not None
    assert find_max_rate_hz(
        LAST_NODE, make_run_with_joints(LAST_NODE, 21.0), CanSettings(imu_rate_hz=5.0)
    ) in (
        None,
        20,
    )


def test_bus_load_beyond_all_settings_suggests_a_lower_rate() -> None:
    text = find_refusal(
        make_run_with_joints(LAST_NODE, 5000.0), CanSettings(channels=name_channels(8))
    )
    assert text is not None
    assert "rate_hz = " in text  # a lower rate always helps
    assert "channels with" not in text
    assert "contact_rate_hz" not in text
