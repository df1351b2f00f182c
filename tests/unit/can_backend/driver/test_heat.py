"""One winding temperature, one torque limit: in the simulator, in emulated joint modules on CAN, and in the status.

Each robot is pushed against a joint's stop, and the torque that the joint gives there is measured.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from snakesim_can_backend.driver.backend import CanBackend
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.physics.thermal import ThermalModel
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import JointMode, Power
from snakesim_sim_backend.backend import SimBackend
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.can.driver_loop import find_chain
from snakesim_testing.contract.rig import BackendRig
from snakesim_testing.hal.small_robots import make_run_config

RATED_NM = 4.0
STEP_NM = 0.003  # of the bus, and what a joint at its stop still sways by
AT_STOP_TICKS = 150
CURVES = {"usual": (80.0, 105.0), "cool": (50.0, 70.0)}


@contextmanager
def hot_robot(backend: str, curve: str, celsius: float) -> Iterator[BackendRig]:
    """The winding of joint_1 stays at a temperature, and the robot is armed."""
    derate_from_c, stop_at_c = CURVES[curve]
    config = make_run_config(
        backend=backend,
        rate_hz=100,
        robot__sensors__power__rate_hz=2.0,
        robot__limits__derate_from_c=derate_from_c,
        robot__limits__stop_at_c=stop_at_c,
        robot__heat__time_constant_s=1e5,
        robot__heat__rise_at_rated_k=1e-3,
    )
    opened = (
        SimBackend(config, SimSettings()) if backend == "sim" else CanBackend(config, CanSettings())
    )
    try:
        windings(opened).winding_temperature_c[0] = celsius
        yield BackendRig(opened, "lockstep", config.period_ns)
    finally:
        opened.close()


def windings(backend: SimBackend | CanBackend) -> ThermalModel:
    if isinstance(backend, SimBackend):
        return backend._windings
    return find_chain(backend).thermal


def until_told(rig: BackendRig, celsius: float) -> None:
    """Until the robot's power samples tell the temperature."""
    for _ in range(100):
        rig.wait_periods()
        power = rig.record_since(rig.tick - 1).samples[-1].by_key.get(keys.POWER)
        if isinstance(power, Power) and power.motor_c[0] == pytest.approx(celsius, abs=0.5):
            return
    raise AssertionError(f"{celsius} °C were not told")


def pushes_nm(rig: BackendRig, limit_nm: float) -> float:
    """What the joint gives at its stop when that much is allowed."""
    limits = [limit_nm, *[RATED_NM] * (rig.joint_count - 1)]
    record = rig.command_without_limiter(
        {0: (JointMode.TORQUE, 2 * RATED_NM)}, AT_STOP_TICKS, torque_limit_nm=limits
    )
    assert np.abs(record.velocity_rad_s[-5:, 0]).max() < 0.05, "it is at its stop"
    return float(record.torque_nm[-5:, 0].mean())


@pytest.mark.parametrize("curve", CURVES)
@pytest.mark.parametrize(
    "over", [0.48, *(pytest.param(at, marks=pytest.mark.slow) for at in (-0.2, 0.96))]
)
@pytest.mark.parametrize("backend", ["sim", "can"])
def test_heat_derates_once(backend: str, curve: str, over: float) -> None:
    """over: how far the winding is from `derate_from_c` to `stop_at_c`."""
    derate_from_c, stop_at_c = CURVES[curve]
    celsius = round(derate_from_c + over * (stop_at_c - derate_from_c))
    share = min(1.0 - 0.8 * (celsius - derate_from_c) / (stop_at_c - derate_from_c), 1.0)
    with hot_robot(backend, curve, celsius) as rig:
        until_told(rig, celsius)
        rig.arm()
        assert rig.authority.derated_joints.get("joint_1", 1.0) == pytest.approx(share, abs=1e-4), (
            "in the status"
        )
        from_gate_nm = rig.authority.compute_setpoints().setpoints.torque_limit_nm[0]
        assert from_gate_nm == pytest.approx(share * RATED_NM, abs=1e-3)
        assert pushes_nm(rig, from_gate_nm) == pytest.approx(share * RATED_NM, abs=STEP_NM), (
            "at the joint"
        )
        assert pushes_nm(rig, RATED_NM) == pytest.approx(share * RATED_NM, abs=STEP_NM), (
            "by the motor's own protection"
        )
        small_nm = 0.1 * RATED_NM
        assert pushes_nm(rig, small_nm) == pytest.approx(small_nm, abs=STEP_NM), (
            "what is little is not made less"
        )


@pytest.mark.parametrize("curve", CURVES)
@pytest.mark.parametrize("backend", ["sim", "can"])
def test_a_winding_at_the_stop_temperature_stops_the_robot(backend: str, curve: str) -> None:
    stop_at_c = CURVES[curve][1]
    with hot_robot(backend, curve, stop_at_c - 1.0) as rig:
        until_told(rig, stop_at_c - 1.0)
        rig.arm()
        windings(rig.backend).winding_temperature_c[0] = stop_at_c + 0.1  # pyright: ignore[reportArgumentType]
        rig.command_joints({}, 60)
        assert rig.authority.state == "fault"
        assert {fault.joint for fault in rig.authority.faults} == {"joint_1"}
