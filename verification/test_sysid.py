"""The comparison with `mujoco.sysid`: what it does without that package, and one robot with it."""

import subprocess
import sys
from pathlib import Path

import pytest

from verification.sysid import BAD_INPUT, PARAMETERS, compare_robot, has_mujoco_sysid, make_table

ROOT = Path(__file__).parents[1]


@pytest.mark.skipif(has_mujoco_sysid(), reason="mujoco.sysid is installed")
def test_missing_packages_are_named_with_the_way_out() -> None:
    command = [sys.executable, "-m", "verification.sysid", "--robots", "1"]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert ended.returncode == BAD_INPUT
    assert 'pip install "mujoco-core[sysid]"' in ended.stderr
    assert not ended.stdout


@pytest.mark.slow
@pytest.mark.skipif(not has_mujoco_sysid(), reason="mujoco.sysid is not installed")
def test_both_methods_find_the_parameters_of_a_robot() -> None:
    pair = compare_robot(1000, ("robot.chain.modules=2",), backlash=False)
    for found in pair:
        errors = [one.error for one in found.estimates if one.error is not None]
        assert len(errors) == 2 * len(PARAMETERS)
        assert max(errors) < 0.3
    assert len(list(make_table([pair]))) == 2 + len(PARAMETERS) + 2
