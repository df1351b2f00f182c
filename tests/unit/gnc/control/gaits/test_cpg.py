"""Tests the coupled oscillators of the gait `cpg`: their limit cycle, and the effect of contact forces on phases."""

import math
from typing import Any

import numpy as np
import pytest

from snakesim_gnc.control.gaits.cpg import MAX_FEEDBACK_RATIO, Cpg, CpgParameters, OscillatorChains
from snakesim_gnc.control.gaits.serpenoid import Serpenoid, SerpenoidParameters
from snakesim_testing.gnc.stage import make_contact, make_stage

PHASES = np.array([0.0, 0.5, 1.0, 1.5])
LIMIT_RAD = np.full((2, 4), 0.2)
FREQUENCY_RAD_S = 4.0
STEP_S = 0.01


def make_oscillators() -> OscillatorChains:
    return OscillatorChains(PHASES, coupling=30.0, amplitude_rate=10.0)


def integrate_for(
    oscillators: OscillatorChains, duration_s: float, feedback_rad_s: Any = 0.0
) -> None:
    """Integrate the oscillators over a duration, with constant feedback."""
    feedback = np.broadcast_to(feedback_rad_s, (2, 4))
    for _ in range(round(duration_s / STEP_S)):
        oscillators.integrate(STEP_S, FREQUENCY_RAD_S, LIMIT_RAD, feedback)


def test_oscillators_after_disturbance_return_to_the_traveling_wave() -> None:
    oscillators = make_oscillators()
    oscillators.theta_rad = oscillators.theta_rad + np.array(
        [[0.8, -0.5, 0.3, 0.0], [0.0, 0.6, -0.9, 0.2]]
    )
    integrate_for(oscillators, 5.0)
    assert np.diff(oscillators.theta_rad[0]) == pytest.approx(np.diff(PHASES), abs=1e-3)
    # The two chains are in opposite phase.
    differences_rad = np.remainder(oscillators.theta_rad[1] - oscillators.theta_rad[0], math.tau)
    assert differences_rad == pytest.approx(math.pi, abs=1e-3)


def test_oscillator_amplitudes_approach_their_limit_without_overshoot() -> None:
    """The equation is critically damped: r = R (1 - (1 + a t / 2) exp(-a t / 2))."""
    oscillators = make_oscillators()
    amplitudes_rad: list[float] = []
    for _ in range(300):
        oscillators.integrate(STEP_S, FREQUENCY_RAD_S, LIMIT_RAD, np.zeros((2, 4)))
        amplitudes_rad.append(float(oscillators.r_rad[0, 0]))
    times_s = STEP_S * np.arange(1, 301)
    expected_rad = 0.2 * (1.0 - (1.0 + 5.0 * times_s) * np.exp(-5.0 * times_s))
    assert np.array(amplitudes_rad) == pytest.approx(expected_rad, abs=0.003)


def test_oscillator_phases_grow_by_the_frequency() -> None:
    oscillators = make_oscillators()
    integrate_for(oscillators, 3.0)
    before_rad = oscillators.theta_rad.copy()
    integrate_for(oscillators, 1.0)
    assert oscillators.theta_rad - before_rad == pytest.approx(FREQUENCY_RAD_S, abs=1e-6)


def test_cpg_limit_cycle_equals_the_serpenoid_curve() -> None:
    stage = make_stage(13)
    cpg = Cpg(stage.robot, CpgParameters(k_theta=0.0))
    serpenoid = Serpenoid(stage.robot, SerpenoidParameters(k_theta=0.0))
    observation = stage.make_observation(0, 0.3)
    cpg_rad = np.zeros(13)
    serpenoid_rad = np.zeros(13)
    for _ in range(640):
        cpg_rad = np.array(cpg.update(observation).telemetry.reference_rad)
        serpenoid_rad = np.array(serpenoid.update(observation).telemetry.reference_rad)
    assert cpg_rad == pytest.approx(serpenoid_rad, abs=0.02)


@pytest.mark.parametrize(("gain", "sign"), [(0.2, 1.0), (-0.2, -1.0), (0.0, 0.0)])
def test_cpg_contact_force_shifts_the_phase_beside_it(gain: float, sign: float) -> None:
    """The shift is sigma F cos(theta): forward while the oscillator is in its first or last quarter."""
    changes_rad: list[float] = []
    for force_n in (0.0, 5.0):
        stage = make_stage(13)
        controller = Cpg(stage.robot, CpgParameters(k_theta=0.0, force_gain=gain))
        free = stage.make_observation(0, 0.3, contacts=[])
        for _ in range(200):
            controller.update(free)
        theta_rad = controller._oscillators.theta_rad
        joint = int(np.cos(theta_rad[0]).argmax())
        contact = make_contact("peg", (0.0, force_n, 0.0), link_index=joint)
        before_rad = float(theta_rad[0, joint])
        controller.update(stage.make_observation(200, 0.3, contacts=[contact]))
        changes_rad.append(float(controller._oscillators.theta_rad[0, joint]) - before_rad)
    without_force_rad, with_force_rad = changes_rad
    assert np.sign(round(with_force_rad - without_force_rad, 6)) == sign


def test_cpg_feedback_of_large_forces_is_limited() -> None:
    stage = make_stage(13)
    parameters = CpgParameters(k_theta=0.0, force_gain=-10.0)
    controller = Cpg(stage.robot, parameters)
    contacts = [make_contact("peg", (0.0, 500.0, 0.0), link_index=link) for link in range(14)]
    observation = stage.make_observation(0, 0.3, contacts=contacts)
    for _ in range(200):
        feedback_rad_s = controller._compute_feedback_rad_s(observation.world)
        controller.update(observation)
        assert (
            np.abs(feedback_rad_s).max()
            <= MAX_FEEDBACK_RATIO * math.tau / parameters.period_s + 1e-12
        )
