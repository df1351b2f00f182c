"""Tests that a diverged simulation is reported at once and permanently, and that its last valid state is readable."""

import mujoco
import numpy as np
import pytest

from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.wire.codec import MessageDecoder, encode, format_encoding
from snakesim_hal.wire.messages import JointMode
from snakesim_testing.messages import raises_error
from snakesim_testing.sim.simulator_rig import SimulatorRig, make_config


def test_divergence_names_tick_joint_and_value_and_keeps_last_state():
    run = SimulatorRig(make_config())
    run.command(JointMode.POSITION, 0.1)
    run.advance(0.1)
    last_valid = run.sim.true_state()
    run.sim.data.qfrc_applied[6 + 4] = 1e9
    with raises_error(BackendError, code="simulator/diverged"):
        run.advance()
    assert run.sim.true_state().angles_rad == pytest.approx(last_valid.angles_rad, abs=1e-12)
    assert run.sample().joints.angle_rad == pytest.approx(last_valid.angles_rad, abs=1e-12)
    with raises_error(BackendError, code="simulator/diverged"):
        run.advance()


@pytest.mark.parametrize(
    ("array_name", "value"), [("qpos", np.nan), ("qvel", np.inf), ("xfrc_applied", np.nan)]
)
def test_divergence_to_nan_or_infinity_is_reported_at_once(array_name, value):
    run = SimulatorRig(make_config())
    getattr(run.sim.data, array_name).flat[10] = value
    with raises_error(BackendError, code="simulator/diverged"):
        run.advance()
    samples = run.sample()
    for message in (samples.joints, *samples.by_key.values()):
        assert (
            MessageDecoder(type(message)).decode(encode(message), format_encoding(type(message)))
            == message
        )  # refuses NaN


def test_divergence_of_motor_too_fast_for_the_step_is_reported():
    """The motor responds faster than a step, its rotor has no inertia, and its torque is huge."""
    robot = {
        "motor": {
            "stiffness_nm_per_rad": 1e5,
            "damping_nm_s_per_rad": 1e3,
            "armature_kg_m2": 0.0,
            "response_time_s": 0.005,
        },
        "limits": {"torque_nm": 1000.0, "speed_rad_s": 100.0},
    }
    run = SimulatorRig(make_config(robot), timestep_s=0.01, contact_time_s=0.02)
    run.command([JointMode.POSITION] * 13, [0.5 * (-1) ** i for i in range(13)])
    with raises_error(BackendError, code="simulator/diverged"):
        run.advance(5.0)


def test_divergence_by_failure_of_mujoco_is_a_backend_error():
    run = SimulatorRig(make_config({"motor": {"friction_nm": 0.1}}))
    run.advance(0.1)
    run.sim.sim.model.opt.solver = 99
    for _attempt in range(2):
        with raises_error(BackendError, code="simulator/diverged"):
            run.advance()


def test_simulator_names_a_robot_that_mujoco_cannot_build(monkeypatch):
    def fail_to_compile(_spec):
        raise ValueError("mass and inertia of moving bodies must be larger than mjMINVAL")

    monkeypatch.setattr(mujoco.MjSpec, "compile", fail_to_compile)
    with raises_error(ConfigError, code="simulator/cannot-build", field="planar13"):
        SimulatorRig(make_config())
