"""One winding temperature, one torque limit: in the simulator, in emulated joint modules on CAN, and in the status.

Each test drives a joint against its stop, and measures the torque there.
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
TOLERANCE_NM = 0.003  # resolution of the bus, and the remaining oscillation of a joint at its stop
AT_STOP_TICKS = 150
DERATING_RANGES_C = {"usual": (80.0, 105.0), "cool": (50.0, 70.0)}


@contextmanager
def open_hot_robot(backend: str, derating: str, celsius: float) -> Iterator[BackendRig]:
    """Open a robot whose winding of joint_1 stays at a temperature."""
    derate_from_c, stop_at_c = DERATING_RANGES_C[derating]
    config = make_run_config(
        backend=backend,
        rate_hz=100,
        robot__sensors__power__rate_hz=2.0,
        robot__limits__derate_from_c=derate_from_c,
        robot__limits__stop_at_c=stop_at_c,
        robot__heat__time_constant_s=1e5,
        robot__heat__rise_at_rated_k=1e-3,
    )
    opened_backend = (
        SimBackend(config, SimSettings()) if backend == "sim" else CanBackend(config, CanSettings())
    )
    try:
        get_windings(opened_backend).winding_temperature_c[0] = celsius
        yield BackendRig(opened_backend, "lockstep", config.period_ns)
    finally:
        opened_backend.close()


def get_windings(backend: SimBackend | CanBackend) -> ThermalModel:
    """Return the thermal model of the windings."""
    if isinstance(backend, SimBackend):
        return backend._windings
    return find_chain(backend).thermal


def wait_for_temperature(rig: BackendRig, celsius: float) -> None:
    """Wait until the power samples of the robot contain the temperature."""
    for _ in range(100):
        rig.wait_periods()
        power = rig.record_since(rig.tick - 1).samples[-1].by_key.get(keys.POWER)
        if isinstance(power, Power) and power.motor_c[0] == pytest.approx(celsius, abs=0.5):
            return
    raise AssertionError(f"{celsius} °C were not published")


def measure_torque_at_stop_nm(rig: BackendRig, limit_nm: float) -> float:
    """Return the torque of joint_1 at its stop with a torque limit."""
    limits = [limit_nm, *[RATED_NM] * (rig.joint_count - 1)]
    record = rig.command_without_limiter(
        {0: (JointMode.TORQUE, 2 * RATED_NM)}, AT_STOP_TICKS, torque_limit_nm=limits
    )
    assert np.abs(record.velocity_rad_s[-5:, 0]).max() < 0.05, "the joint is at its stop"
    return float(record.torque_nm[-5:, 0].mean())


@pytest.mark.parametrize("derating", DERATING_RANGES_C)
@pytest.mark.parametrize(
    "heat_fraction",
    [0.48, *(pytest.param(fraction, marks=pytest.mark.slow) for fraction in (-0.2, 0.96))],
)
@pytest.mark.parametrize("backend", ["sim", "can"])
def test_hot_winding_reduces_torque_only_once(
    backend: str, derating: str, heat_fraction: float
) -> None:
    """Check the derating, where `heat_fraction` is 0 at `derate_from_c` and 1 at `stop_at_c`."""
    derate_from_c, stop_at_c = DERATING_RANGES_C[derating]
    celsius = round(derate_from_c + heat_fraction * (stop_at_c - derate_from_c))
    torque_fraction = min(1.0 - 0.8 * (celsius - derate_from_c) / (stop_at_c - derate_from_c), 1.0)
    with open_hot_robot(backend, derating, celsius) as rig:
        wait_for_temperature(rig, celsius)
        rig.arm()
        assert rig.authority.derated_joints.get("joint_1", 1.0) == pytest.approx(
            torque_fraction, abs=1e-4
        ), "in the status"
        limit_nm = rig.authority.compute_setpoints().setpoints.torque_limit_nm[0]
        assert limit_nm == pytest.approx(torque_fraction * RATED_NM, abs=1e-3)
        assert measure_torque_at_stop_nm(rig, limit_nm) == pytest.approx(
            torque_fraction * RATED_NM, abs=TOLERANCE_NM
        ), "at the joint"
        assert measure_torque_at_stop_nm(rig, RATED_NM) == pytest.approx(
            torque_fraction * RATED_NM, abs=TOLERANCE_NM
        ), "by the motor's own protection"
        small_nm = 0.1 * RATED_NM
        assert measure_torque_at_stop_nm(rig, small_nm) == pytest.approx(
            small_nm, abs=TOLERANCE_NM
        ), "a small torque is not reduced"


@pytest.mark.parametrize("derating", DERATING_RANGES_C)
@pytest.mark.parametrize("backend", ["sim", "can"])
def test_winding_at_stop_temperature_stops_the_robot(backend: str, derating: str) -> None:
    stop_at_c = DERATING_RANGES_C[derating][1]
    with open_hot_robot(backend, derating, stop_at_c - 1.0) as rig:
        wait_for_temperature(rig, stop_at_c - 1.0)
        rig.arm()
        get_windings(rig.backend).winding_temperature_c[0] = stop_at_c + 0.1  # pyright: ignore[reportArgumentType]
        rig.command_joints({}, 60)
        assert rig.authority.state == "fault"
        assert {fault.joint for fault in rig.authority.faults} == {"joint_1"}
