"""An emulated hand bends joints whose motors are off."""

from pathlib import Path

import numpy as np
import pytest

from snakesim_drivers.emulation.inertia import InertiaModel, InertiaSettings
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.scenario import load_scenario, parse_set_option

JOINTS = 3
STEPS = 1500


def make_model(pose_file: Path) -> InertiaModel:
    options = (f"robot.chain.modules={JOINTS}", "start.on_route=false")
    config = load_scenario("joint_check", [parse_set_option(text) for text in options]).config
    return InertiaModel(config, InertiaSettings(hand_file=str(pose_file)))


def test_hand_bends_joints_that_are_off_and_releases_them(tmp_path: Path) -> None:
    pose_file = tmp_path / "pose.txt"
    model = make_model(pose_file)
    off_nm = np.zeros(JOINTS)
    model.advance(off_nm)
    assert model.angle_rad.tolist() == [0.0] * JOINTS
    pose_file.write_text("0.5 -0.4 0.0")
    for _ in range(STEPS):
        model.advance(off_nm)
    assert model.angle_rad == pytest.approx([0.5, -0.4, 0.0], abs=1e-6)
    for _ in range(STEPS):  # a motor moves a joint freely
        model.advance(np.array([0.3, 0.0, 0.0]))
    assert model.angle_rad[0] > 0.6


def test_hand_does_not_touch_a_joint_that_a_motor_drives(tmp_path: Path) -> None:
    pose_file = tmp_path / "pose.txt"
    pose_file.write_text("0.5 0.5 0.5")
    model = make_model(pose_file)
    for _ in range(STEPS // 3):
        model.advance(
            np.array([0.09, 0.0, 0.0])
        )  # this torque is below the dry friction of the joint
    assert model.angle_rad == pytest.approx([0.0, 0.5, 0.5], abs=1e-6)


@pytest.mark.parametrize("text", ["0.5 0.5", "0.5 0.5 left", "0.5 0.5 nan"])
def test_hand_invalid_pose_file_is_an_error(tmp_path: Path, text: str) -> None:
    pose_file = tmp_path / "pose.txt"
    pose_file.write_text(text)
    with pytest.raises(BackendError, match="write 3 angles in rad"):
        make_model(pose_file).advance(np.zeros(JOINTS))
