"""Mode switches: no change of mode makes the torque jump."""

import numpy as np
import pytest

from snakesim_hal.wire.messages import JointMode
from snakesim_testing.contract import tolerances
from snakesim_testing.contract.recordings import MODE_SWITCHES
from snakesim_testing.contract.rig import BackendRig, Floats

SWITCH_NAMES = [f"{before.name}_to_{after.name}".lower() for before, after in MODE_SWITCHES]


@pytest.mark.parametrize(("before", "after"), MODE_SWITCHES, ids=SWITCH_NAMES)
def test_a_mode_switch_makes_no_jump(
    rig: BackendRig,
    switching: dict[tuple[JointMode, JointMode], Floats],
    before: JointMode,
    after: JointMode,
) -> None:
    """When a joint changes its mode, with small targets, its torque jumps by less than a quarter of the maximum."""
    for mode in (before, after):
        if not rig.supports_mode(0, mode):
            pytest.skip(f"{rig.robot.joints[0].name} is described without {mode.name.lower()} mode")
    rig.skip_without(torque=True)
    max_step_nm = tolerances.MAX_TORQUE_STEP_FRACTION * rig.full_torque_nm[0]
    torque_steps_nm = np.abs(np.diff(switching[before, after]))
    assert torque_steps_nm.max() < max_step_nm, (
        f"the torque changed by {torque_steps_nm.max():.2f} N·m in one tick; allowed are {max_step_nm:.2f} N·m"
    )
