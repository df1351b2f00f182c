"""Coupled oscillators: their limit cycle, and what forces do to their phases."""

import math
from typing import Any

import numpy as np
import pytest

from snakesim_gnc.control.gaits.cpg import MAX_FEEDBACK_RATIO, Cpg, CpgParameters, OscillatorChains
from snakesim_gnc.control.gaits.serpenoid import Serpenoid, SerpenoidParameters
from snakesim_testing.gnc.stage import make_contact, make_stage

PHASES = np.array([0.0, 0.5, 1.0, 1.5])
LIMIT_RAD = np.full((2, 4), 0.2)
TURN_RAD_S = 4.0


def advance(oscillators: OscillatorChains, seconds: float, feedback_rad_s: Any = 0.0) -> None:
    feedback = np.broadcast_to(feedback_rad_s, (2, 4))
    for _ in range(round(seconds / 0.01)):
        oscillators.integrate(0.01, TURN_RAD_S, LIMIT_RAD, feedback)


def test_disturbed_oscillators_return_to_the_traveling_wave() -> None:
    oscillators = OscillatorChains(PHASES, coupling=30.0, amplitude_rate=10.0)
    oscillators.theta_rad = oscillators.theta_rad + np.array(
        [[0.8, -0.5, 0.3, 0.0], [0.0, 0.6, -0.9, 0.2]]
    )
    advance(oscillators, 5.0)
    assert np.diff(oscillators.theta_rad[0]) == pytest.approx(np.diff(PHASES), abs=1e-3)
    across = np.remainder(oscillators.theta_rad[1] - oscillators.theta_rad[0], math.tau)
    assert across == pytest.approx(math.pi, abs=1e-3)


def test_amplitudes_approach_their_limit_without_overshoot() -> None:
    """The equation is critically damped: r = R (1 - (1 + a t / 2) exp(-a t / 2))."""
    oscillators = OscillatorChains(PHASES, coupling=30.0, amplitude_rate=10.0)
    seen: list[float] = []
    for _ in range(300):
        oscillators.integrate(0.01, TURN_RAD_S, LIMIT_RAD, np.zeros((2, 4)))
        seen.append(float(oscillators.r_rad[0, 0]))
    time_s = 0.01 * np.arange(1, 301)
    exact = 0.2 * (1.0 - (1.0 + 5.0 * time_s) * np.exp(-5.0 * time_s))
    assert np.array(seen) == pytest.approx(exact, abs=0.003)


def test_the_phase_grows_by_the_frequency() -> None:
    oscillators = OscillatorChains(PHASES, coupling=30.0, amplitude_rate=10.0)
    advance(oscillators, 3.0)
    before = oscillators.theta_rad.copy()
    advance(oscillators, 1.0)
    assert oscillators.theta_rad - before == pytest.approx(TURN_RAD_S, abs=1e-6)


def test_the_limit_cycle_is_the_serpenoid_curve() -> None:
    stage = make_stage(13)
    cpg = Cpg(stage.robot, CpgParameters(k_theta=0.0))
    serpenoid = Serpenoid(stage.robot, SerpenoidParameters(k_theta=0.0))
    observation = stage.make_observation(0, 0.3)
    oscillating, curve = np.zeros(13), np.zeros(13)
    for _ in range(640):
        oscillating = np.array(cpg.update(observation).telemetry.reference_rad)
        curve = np.array(serpenoid.update(observation).telemetry.reference_rad)
    assert oscillating == pytest.approx(curve, abs=0.02)


@pytest.mark.parametrize(("gain", "sign"), [(0.2, 1.0), (-0.2, -1.0), (0.0, 0.0)])
def test_a_force_shifts_the_phases_beside_it(gain: float, sign: float) -> None:
    """By sigma F cos(theta): forward while the oscillator on the pushed side is in its first or last quarter."""
    changes: list[float] = []
    for force_n in (0.0, 5.0):
        stage = make_stage(13)
        controller = Cpg(stage.robot, CpgParameters(k_theta=0.0, force_gain=gain))
        free = stage.make_observation(0, 0.3, contacts=[])
        for _ in range(200):
            controller.update(free)
        theta = controller._oscillators.theta_rad
        joint = int(np.cos(theta[0]).argmax())
        contact = make_contact("peg", (0.0, force_n, 0.0), link_index=joint)
        before = float(theta[0, joint])
        controller.update(stage.make_observation(200, 0.3, contacts=[contact]))
        changes.append(float(controller._oscillators.theta_rad[0, joint]) - before)
    undisturbed, pushed = changes
    assert np.sign(round(pushed - undisturbed, 6)) == sign


def test_no_force_stops_an_oscillator() -> None:
    stage = make_stage(13)
    parameters = CpgParameters(k_theta=0.0, force_gain=-10.0)
    controller = Cpg(stage.robot, parameters)
    contacts = [make_contact("peg", (0.0, 500.0, 0.0), link_index=link) for link in range(14)]
    observation = stage.make_observation(0, 0.3, contacts=contacts)
    for _ in range(200):
        feedback = controller._compute_feedback_rad_s(observation.world)
        controller.update(observation)
        assert np.abs(feedback).max() <= MAX_FEEDBACK_RATIO * math.tau / parameters.period_s + 1e-12
