"""Flat ground pushes nobody: what moves a mirrored, reversed or turned snake is mirrored, reversed or turned as well.

A symmetric snake whose wave runs the other way must drift the other way, by as much, whatever the physics step. What is
left over is a force that no ground has.
"""

import numpy as np
import pytest

from snakesim_hal.model.scene_file.friction import DirectionalFriction
from snakesim_testing.sim.waves import BodyTrack, JointWave, integrate_momentum_balance
from snakesim_testing.sim.waves import simulate_wave as swim_on

MU = 0.1
GHOST_MM_S = 1.0
SEED = 20261123


def swim(wave: JointWave, step_s: float = 0.002, *, yaw_rad: float = 0.0) -> BodyTrack:
    """The shipped robot on flat ground."""
    return swim_on(wave, {"friction": MU}, step_s=step_s, yaw_rad=yaw_rad)


def random_waves(count: int) -> list[JointWave]:
    rng = np.random.default_rng(SEED)
    return [
        JointWave(
            rng.uniform(0.2, 0.6),
            rng.uniform(0.5, 1.2),
            rng.uniform(2.0, 5.0),
            rng.uniform(-0.05, 0.05),
        )
        for _ in range(count)
    ]


FIRST, *OTHERS = random_waves(4)


@pytest.mark.parametrize(
    "wave", [FIRST, *(pytest.param(wave, marks=pytest.mark.slow) for wave in OTHERS)]
)
def test_a_reversed_wave_drifts_the_other_way_by_as_much(wave: JointWave) -> None:
    there, back = swim(wave).drift_mm_s, swim(wave.reversed).drift_mm_s
    assert abs(there + back) < GHOST_MM_S
    assert max(abs(there), abs(back)) > 3.0


@pytest.mark.slow
@pytest.mark.timeout(600)  # 60 runs, in steps of down to 0.5 ms
@pytest.mark.parametrize("step_s", [0.0005, 0.001, 0.002])
def test_waves_drift_oppositely_when_reversed(step_s: float) -> None:
    sums, differences, speeds = [], [], []
    for wave in random_waves(20):
        there = swim(wave, step_s).drift_mm_s
        sums.append(abs(there + swim(wave.reversed, step_s).drift_mm_s))
        differences.append(abs(there - swim(wave, 0.001).drift_mm_s))
        speeds.append(abs(there))
    print(
        f"steps of {step_s * 1e3:g} ms: drift {min(speeds):.1f} to {max(speeds):.1f} mm/s, of a wave and "
        f"its reverse in sum at most {max(sums):.2f} mm/s, from that with 1 ms at most {max(differences):.2f} mm/s"
    )
    assert max(sums) < GHOST_MM_S
    assert max(differences) < GHOST_MM_S


def test_reflected_or_rotated_snake_moves_reflected_or_rotated() -> None:
    wave, yaw_rad = JointWave(bend=0.04), 0.7
    reflected = JointWave(-wave.amplitude, bend=-wave.bend)
    plain = swim(wave).center[-1]
    assert np.linalg.norm(plain) > 0.02
    assert swim(reflected).center[-1] == pytest.approx(plain * [1.0, -1.0], abs=1e-6)
    turned = complex(*plain) * np.exp(1j * yaw_rad)
    assert swim(wave, yaw_rad=yaw_rad).center[-1] == pytest.approx(
        [turned.real, turned.imag], abs=1e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "wave",
    [
        pytest.param(JointWave(), marks=pytest.mark.slow),
        JointWave().reversed,
        JointWave(0.3, 0.7, 4.0),
        JointWave(0.7, -0.75, 7.854),  # of the search for contacts
    ],
)
def test_it_drifts_as_a_momentum_balance_with_coulomb_friction_says(wave: JointWave) -> None:
    ours, balance = (
        swim(wave).drift_mm_s,
        integrate_momentum_balance(wave, DirectionalFriction(MU, MU, MU)).drift_mm_s,
    )
    print(f"{wave}: {ours:+.2f} mm/s, momentum balance {balance:+.2f} mm/s")
    assert ours == pytest.approx(balance, abs=GHOST_MM_S)
