"""A simulation that blows up is reported once and for all, and its last good state stays readable."""

import numpy as np
import pytest

from snakesim_hal.errors import BackendError
from snakesim_hal.messages import Mode
from tests.unit.sim_backend.rig import Run, make_config


def test_a_runaway_names_tick_joint_and_value_and_the_last_good_state_stays(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file in the working directory
    run = Run(make_config())
    run.command(Mode.POSITION, 0.1)
    run.go(0.1)
    good = run.sim.true_state()
    run.sim.data.qfrc_applied[6 + 4] = 1e9
    with pytest.raises(BackendError, match=r"tick 11: joint_[456] moves at \S+ rad/s and accelerates at \S+ rad/s²"):
        run.go()
    assert run.sim.true_state().angles_rad == pytest.approx(good.angles_rad, abs=1e-12)
    assert run.sample().joints.angle_rad == pytest.approx(good.angles_rad, abs=1e-12)
    with pytest.raises(BackendError, match="tick 11"):
        run.go()


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("where", ["qpos", "qvel", "xfrc_applied"])
def test_what_is_no_number_is_found_at_once(where, value, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = Run(make_config())
    getattr(run.sim.data, where).flat[10] = value
    with pytest.raises(BackendError, match="diverged at tick 1"):
        run.go()
    assert np.all(np.isfinite(run.sample().joints.angle_rad))


def test_gains_far_too_high_for_the_step_are_found_out(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wild = {"motor": {"stiffness_nm_per_rad": 1e5, "damping_nm_s_per_rad": 0.0, "armature_kg_m2": 0.0}}
    wild["limits"] = {"torque_nm": 1000.0, "speed_rad_s": 100.0}
    run = Run(make_config(wild, {"ground": {"friction": 0.0}}), timestep_s=0.01, contact_time_s=0.02)
    run.command([Mode.POSITION] * 13, [0.5 * (-1) ** i for i in range(13)])
    try:
        run.go(1.0)
    except BackendError as error:
        assert "diverged at tick" in str(error)
    assert np.all(np.isfinite(run.sim.true_state().angles_rad))


def test_nothing_moves_after_closing():
    run = Run(make_config())
    run.sim.close()
    run.sim.close()
    with pytest.raises(BackendError, match="closed"):
        run.go()
    assert run.sim.faults() == []
