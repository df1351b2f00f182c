"""The driver reports each fault of a module in time, with its joint, and every joint comes to rest."""

import numpy as np
import pytest

from snakesim_can_backend.protocol.definitions import ModuleState
from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.fault_kinds import parse_injection
from snakesim_testing.can.driver_loop import open_driver_loop, reset_and_arm_again
from snakesim_testing.can.module_faults import MODULE_FAULTS
from snakesim_testing.messages import raises_error

START_TICK = 60
AT_REST_RAD_S = 0.05


@pytest.mark.parametrize(
    ("kind", "expected_fault", "max_periods"), MODULE_FAULTS, ids=[row[0] for row in MODULE_FAULTS]
)
def test_module_fault_names_its_joint_and_stops_the_robot(
    kind: str, expected_fault: str, max_periods: int
) -> None:
    with open_driver_loop(faults=[f"{kind}:joint_3@{START_TICK / 100}"]) as run:
        run.arm()
        run.run(START_TICK - run.tick, run.wave_joints)
        assert not run.faults
        run.run(max_periods, run.wave_joints)
        assert run.faults, f"{kind} was not seen within {max_periods} periods"
        fault = run.faults[0]
        run.run(30)
        rest_tick = (
            max(
                tick
                for tick in range(START_TICK, run.tick)
                if run.true_speed_rad_s[tick] > AT_REST_RAD_S
            )
            + 1
        )
        healthy_joints = [i for i in range(4) if i != 2]
        assert fault.what in (
            expected_fault,
            "module_silent" if kind == "reboot" else expected_fault,
        )
        assert fault.joint == "joint_3"
        assert "joint_3 (node 3 on " in fault.cause
        assert expected_fault in [reported.what for reported in run.faults]
        assert rest_tick < run.tick - 5, "everything comes to rest"
        assert all(run.states()[i] == ModuleState.DISARMED for i in healthy_joints), run.states()
        if kind != "reboot":  # a reboot ends by itself
            run.backend.inject(parse_injection(f"{kind}:joint_3@0"), begins=False)
            run.run(10)
        if kind != "overheat":  # a hot winding cools for minutes
            reset_and_arm_again(run)


def test_duplicate_module_is_detected_before_any_drive_is_enabled() -> None:
    with (
        raises_error(BackendError, code="drive/not-complete"),
        open_driver_loop(faults=["duplicate:joint_3@0"]),
    ):
        pass


def test_persistent_fault_is_reported_again_and_blocks_arming_until_gone() -> None:
    with open_driver_loop(faults=["leak:joint_1@0.3-0.8"]) as run:
        run.arm()
        run.run(60, run.wave_joints)
        assert [fault.what for fault in run.faults] == ["module_leak"]
        assert run.lifecycle == "fault"
        run.lifecycle = "disarmed"
        run.run(20)
        assert [fault.what for fault in run.faults] == ["module_leak", "module_leak"]
        assert run.lifecycle == "fault"
        run.lifecycle = "disarmed"
        run.run(10)
        assert run.states() == [ModuleState.DISARMED] * 4
        assert len(run.faults) == 2
        angles_before_rad = list(run.samples[-1].joints.angle_rad)
        run.setpoints = None
        run.arm()
        assert np.allclose(run.samples[-1].joints.angle_rad, angles_before_rad, atol=0.02)
