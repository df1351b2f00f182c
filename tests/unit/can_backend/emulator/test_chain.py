"""The chain of emulated modules: stepped time and real time, contact reports, and reproducible frames."""

from typing import Any

import msgspec
import numpy as np
import pytest

from snakesim_can_backend.emulator.chain import MAX_AT_ONCE_US
from snakesim_can_backend.emulator.frames import ALONG, ANGLE, FORCE
from snakesim_can_backend.protocol.commands import make_command, make_sync
from snakesim_can_backend.protocol.definitions import (
    CommandAction,
    ModuleParameter,
    ModuleState,
    Opcode,
)
from snakesim_drivers.motion_capture.mocap_sample import MocapSample
from snakesim_hal.physics.physics_model import LinkLoad
from snakesim_hal.wire.messages import Imu, JointMode
from snakesim_testing.can.driver_loop import make_can_config
from snakesim_testing.can.module_rig import RigHost, decode_frames_of, make_chain, make_setpoint
from snakesim_testing.hal.small_robots import make_pose

GRAVITY_M_S2 = 9.81
POSE = make_pose(
    position_w=(1.0, 2.0, 0.1), velocity_w=(0.1, 0.0, 0.0), angular_velocity_w=(0.0, 0.0, 0.5)
)


class PushedModel:
    """A physics model that is stationary, with contact forces on two links."""

    step_s = 0.001

    def __init__(self, joints: int) -> None:
        self.angle_rad = np.linspace(-0.5, 0.5, joints)
        self.velocity_rad_s = np.zeros(joints)
        self.steps = 0

    def advance(self, torque_nm) -> None:
        self.steps += 1

    def shaft_torque_nm(self):
        return np.full(len(self.angle_rad), 0.25)

    def loads(self):
        return [
            LinkLoad(0, (0.02, 0.03, 0.0), (0.0, -5.0, 0.0)),
            LinkLoad(2, (0.05, -0.03, 0.0), (1.0, 12.0, 999.0)),
        ]

    def imu(self):
        links = list(range(len(self.angle_rad) + 1))
        return Imu(
            tick=0,
            timestamp_ns=0,
            link=links,
            angular_velocity_rad_s=[(float(i), 0.0, 0.0) for i in links],
            acceleration_m_s2=[(0.0, 0.0, GRAVITY_M_S2)] * len(links),
        )

    def pose(self):
        return POSE


SENSORS: dict[str, Any] = {
    "robot__sensors": {"contacts": {"threshold_n": 0.1}, "imu": {}, "pose": {}}
}


TIME_RANGE_US = 1 << 32  # us, range of the time in a Sync
SYNCS = {  # times of Syncs in us, and the steps of 1 ms that are simulated by then
    "across the wrap-around of 32 bits": [
        (TIME_RANGE_US - 15_000, 0),
        (TIME_RANGE_US - 15_000, 0),
        (TIME_RANGE_US - 5_000, 10),
        (TIME_RANGE_US + 5_000, 20),
        (TIME_RANGE_US - 5_000, 20),
    ],
    "late on another bus, and a new host": [
        (0, 0),
        (5_010_000, 5010),
        (5_000_000, 5010),
        (5_010_000, 5010),
        (5_020_000, 5020),
        (0, 5020),
        (10_000, 5030),
    ],
    "of another clock, half an hour ahead": [
        (0, 0),
        (10_000, 10),
        (60_010_000, 60_010),
        (2_000_000_000, 60_010),
        (2_000_010_000, 60_020),
    ],
}


@pytest.mark.parametrize("syncs", SYNCS.values(), ids=list(SYNCS))
def test_chain_time_advances_only_from_sync_to_later_sync(syncs: list[tuple[int, int]]):
    physics_model = PushedModel(4)
    module_chain = make_chain(physics_model=physics_model)
    for time_us, steps in syncs:
        module_chain.receive(0, make_sync(0, time_us))
        module_chain.receive(0, make_command(CommandAction.IDENTIFY))
        assert physics_model.steps == steps


def test_chain_two_buses_with_same_sync_share_one_step():
    physics_model = PushedModel(5)
    module_chain = make_chain(
        make_can_config(5), physics_model=physics_model, channels=["vcan0", "vcan1"]
    )
    for tick in range(3):
        for channel in (0, 1):
            module_chain.receive(channel, make_sync(tick, tick * 10_000))
    assert physics_model.steps == 20
    assert module_chain.modules_per_bus == [3, 2]
    assert [
        item["count"] for item in decode_frames_of(module_chain.pop_frames(1), Opcode.JOINT_STATE)
    ] == [
        0,
        0,
        1,
        1,
        2,
        2,
    ]
    module_chain.receive(1, make_command(CommandAction.ARM))
    assert [item.module.state for item in module_chain.slots] == [1, 1, 1, 2, 2]
    module_chain.receive(0, make_setpoint(0, node_id=4))
    assert module_chain.slots[3].module._pending_demand is None, "node 4 is on the other bus"


def test_chain_contact_force_is_measured_by_neighbor_links():
    module_chain = make_chain(make_can_config(**SENSORS), physics_model=PushedModel(4))
    module_chain.slots[0].module.parameters.values[ModuleParameter.TAIL] = 1.0
    module_chain.receive(0, make_sync(0, 0))
    frames = module_chain.pop_frames(0)
    contacts = decode_frames_of(frames, Opcode.CONTACT)
    assert [report["touched"] for report in contacts] == [0, 1, 0, 0]
    assert contacts[1]["force_y"] == pytest.approx(12.0)
    assert contacts[1]["force_z"] == pytest.approx(204.75)
    assert contacts[1]["along"] == pytest.approx(0.05) and contacts[1]["bearing"] == pytest.approx(
        -np.pi
    ), "half a revolution"
    [tail] = decode_frames_of(frames, Opcode.TAIL_CONTACT)
    assert tail["force_y"] == pytest.approx(-5.0)
    assert tail["bearing"] == 0.0


def test_chain_modules_send_imu_reports_in_turn():
    module_chain = make_chain(make_can_config(**SENSORS), physics_model=PushedModel(4))
    for slot in module_chain.slots:
        slot.module.parameters.values[ModuleParameter.IMU_EVERY] = 4.0
    for tick in range(4):
        module_chain.receive(0, make_sync(tick, 0))
        gyros = decode_frames_of(module_chain.pop_frames(0), Opcode.GYRO)
        assert len(gyros) == 1
        assert gyros[0]["rate_x"] in (1.0, 2.0, 3.0, 4.0)
    module_chain.receive(0, make_sync(4, 0))
    frames = module_chain.pop_frames(0)
    assert decode_frames_of(frames, Opcode.ACCELEROMETER)[0]["acceleration_z"] == pytest.approx(
        GRAVITY_M_S2
    )
    assert decode_frames_of(frames, Opcode.SHAFT_LOAD)[0]["torque"] == pytest.approx(0.25)


def test_chain_pose_is_sent_once_per_sync():
    sent: list[bytes] = []
    module_chain = make_chain(
        make_can_config(6, **SENSORS),
        physics_model=PushedModel(6),
        channels=["a", "b"],
        send_pose=sent.append,
    )
    for tick in range(3):
        for channel in (0, 1):
            module_chain.receive(channel, make_sync(tick, tick * 10_000))
    assert len(sent) == 3
    sample = msgspec.json.decode(sent[0], type=MocapSample)
    assert sample.position_w == POSE.position_w
    assert sample.angular_velocity_w == POSE.angular_velocity_w


def run_with_noise(seed: int) -> tuple[list, list]:
    """Run the emulators with noise, and return the frames of every tick and the final states."""
    settings: dict[str, Any] = {
        "robot__sensors": {"joints": {"angle_noise_rad": 1e-3}},
        "seed": seed,
    }
    host = RigHost(make_chain(make_can_config(**settings)))
    host.arm()
    return [host.run_tick(0.3 if tick < 50 else -0.3) for tick in range(100)], host.states()


def test_chain_with_same_seed_sends_the_same_frames():
    frames, states = run_with_noise(1)
    assert (frames, states) == run_with_noise(1)
    assert states == [ModuleState.ARMED] * 4
    assert frames != run_with_noise(2)[0]
    angles = [state["angle"] for state in decode_frames_of(frames[49], Opcode.JOINT_STATE)]
    assert angles == pytest.approx([0.3] * 4, abs=0.01)


def test_chain_watchdog_in_stepped_time_ends_within_the_step():
    host = RigHost(make_chain())
    host.arm()
    for _ in range(5):
        host.run_tick(2.0, JointMode.TORQUE)
    frames = [frame for _ in range(12) for frame in host.run_tick()]
    assert host.states() == [ModuleState.FAULT] * 4
    uptimes_s = [
        heartbeat["uptime"]
        for heartbeat in decode_frames_of(frames, Opcode.HEARTBEAT, 1)
        if heartbeat["last_stop"] == 3
    ]
    assert uptimes_s[0] == pytest.approx(0.1 + 0.05 + 0.1, abs=0.0011)


def test_chain_in_real_time_catches_up_only_short_pauses():
    physics_model = PushedModel(4)
    module_chain = make_chain(physics_model=physics_model, is_stepped=False)
    module_chain.advance_to(150_000.0)
    assert physics_model.steps == 150
    module_chain.advance_to(1_150_000.0)
    assert physics_model.steps == 350
    assert module_chain.skipped_us == 1e6 - MAX_AT_ONCE_US
    module_chain.advance_to(1_160_000.0)
    assert physics_model.steps == 360


def test_chain_hot_module_derates_its_torque():
    host = RigHost(make_chain(physics_model=PushedModel(4)))
    host.arm()
    host.chain.thermal.winding_temperature_c[1] = 95.0
    frames = host.run_ticks(10, 4.0, JointMode.TORQUE)
    states = decode_frames_of(frames, Opcode.JOINT_STATE)
    assert [state["derated"] for state in states] == [0, 1, 0, 0]
    assert states[1]["torque"] / 4.0 == pytest.approx(1.0 - 0.8 * 15 / 25, abs=0.01)
    assert states[0]["torque"] > 3.9


def test_chain_values_out_of_range_saturate_without_error():
    assert ANGLE.to_raw(99.0) == 32767
    assert ANGLE.to_raw(-99.0) == -32768
    assert ANGLE.to_raw_array(np.array([np.nan, np.inf, -np.inf, 0.1])) == [0, 32767, -32768, 1000]
    assert FORCE.to_raw(float("inf")) == 4095
    assert ALONG.to_raw(float("nan")) == 0
