"""Mode switches: no change of mode makes the torque jump."""

import numpy as np
import pytest

from snakesim_hal.wire.messages import Mode
from snakesim_testing.contract import tolerances as t
from snakesim_testing.contract.recordings import PAIRS
from snakesim_testing.contract.rig import Floats, Rig

NAMES = [f"{before.name}_to_{after.name}".lower() for before, after in PAIRS]


@pytest.mark.parametrize(("before", "after"), PAIRS, ids=NAMES)
def test_a_mode_switch_makes_no_jump(
    rig: Rig, switching: dict[tuple[Mode, Mode], Floats], before: Mode, after: Mode
) -> None:
    """Every ordered pair of modes, with small targets: no tick changes the torque by a quarter of the maximum."""
    for mode in (before, after):
        if not rig.supports_mode(0, mode):
            pytest.skip(f"{rig.robot.joints[0].name} is described without {mode.name.lower()} mode")
    rig.skip_without(torque=True)
    most = t.BUMP_SHARE * rig.full_torque_nm[0]
    steps = np.abs(np.diff(switching[before, after]))
    assert steps.max() < most, f"torque changed by {steps.max():.2f} N·m in a tick; at most {most:.2f} N·m"
