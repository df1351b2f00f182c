"""Liljebäck, Pettersen, Stavdahl and Gravdahl 2011: the speed of lateral undulation by amplitude and frequency."""

import math
from collections.abc import Sequence

from snakesim_operator.features.reproduce.experiment import (
    DifferenceReason,
    Experiment,
    ExperimentFindings,
    ExperimentPicture,
    PictureCurve,
    PublishedComparison,
    PublishedSource,
    fit_exponent,
)
from snakesim_operator.features.reproduce.gait_motion import GaitMotion
from snakesim_operator.features.reproduce.planar_chain import JointWaves, find_chain_motion
from snakesim_operator.features.reproduce.trials import ExperimentTrials, GaitRun, set_viscous

MODULES = 9  # joints
LAG_RAD = math.radians(40)  # of a joint behind the one ahead of it
AMPLITUDES_RAD = tuple(math.radians(angle) for angle in (5.0, 7.5, 10.0, 15.0, 20.0))
AMPLITUDE_RAD = math.radians(10)  # at which the period changes
PERIODS_S = (2.0, 3.0, 4.0, 6.0)
PERIOD_S = 4.0  # at which the amplitude changes
ALONG_S_PER_M = 3.0
DRAG_RATIO = 3.0


class LiljebackVelocity(Experiment):
    """Exponents of the speed in amplitude and frequency."""

    name = "liljeback-velocity"
    source = PublishedSource(
        authors="P. Liljebäck, K. Y. Pettersen, Ø. Stavdahl and J. T. Gravdahl",
        title="Experimental Investigation of Fundamental Properties of Snake Robot Locomotion",
        published_in="IEEE/RSJ International Conference on Intelligent Robots and Systems",
        year=2011,
        place="abstract, properties 1 and 2",
        seen="The abstract, in a copy without a year. We have not read the friction of the robot and its measured "
        "speeds.",
    )
    claim = (
        "The average forward velocity is proportional to the squared amplitude of the sinusoidal joint motion, and to "
        "its angular frequency."
    )
    published_conditions = (
        "The properties are derived from a model, and supported by measurements of a robot. The abstract prints no "
        "friction."
    )
    our_conditions = (
        "10 links, a phase of 40 degrees between joints, and viscous ground with three times as much friction across "
        "a link as along it. Amplitudes of 5 to 20 degrees with a period of 4 s, and periods of 2 to 6 s with 10 "
        "degrees."
    )
    method = (
        "The exponents come from a least-squares fit of the logarithms. The speed is that of the center of mass along "
        "the body over two periods, after two periods that are not counted."
    )

    def run(self, trials: ExperimentTrials) -> ExperimentFindings:
        """Measure the speed at several amplitudes, and at several periods."""
        amplitudes_rad = AMPLITUDES_RAD[::4] if trials.is_quick else AMPLITUDES_RAD
        periods_s = PERIODS_S[::2] if trials.is_quick else PERIODS_S
        amplitude_runs = [_make_run(amplitude_rad, PERIOD_S) for amplitude_rad in amplitudes_rad]
        period_runs = [_make_run(AMPLITUDE_RAD, period_s) for period_s in periods_s]
        runs = [*amplitude_runs, *period_runs]
        motions = trials.measure(runs)
        by_amplitude = [motion.speed_m_s for motion in motions[: len(amplitudes_rad)]]
        by_period = [motion.speed_m_s for motion in motions[len(amplitudes_rad) :]]
        frequencies_hz = [1.0 / period_s for period_s in periods_s]
        amplitude_exponent = fit_exponent(amplitudes_rad, by_amplitude)
        frequency_exponent = fit_exponent(frequencies_hz, by_period)

        chain = trials.call(find_chain_speed, list(zip(runs, motions, strict=True)))
        chain_amplitude = fit_exponent(amplitudes_rad, chain[: len(amplitudes_rad)])
        chain_frequency = fit_exponent(frequencies_hz, chain[len(amplitudes_rad) :])
        endless = fit_exponent(
            amplitudes_rad, [_find_saturating_speed(amplitude) for amplitude in amplitudes_rad]
        )
        comparisons = (
            PublishedComparison(
                quantity="exponent of the amplitude, 5 to 20 degrees",
                unit="1",
                published=2.0,
                basis="printed",
                ours=amplitude_exponent,
                runs=len(amplitudes_rad),
            ),
            PublishedComparison(
                quantity="exponent of the frequency, 1/6 to 1/2 Hz",
                unit="1",
                published=1.0,
                basis="printed",
                ours=frequency_exponent,
                runs=len(periods_s),
            ),
        )
        reasons = (
            DifferenceReason(
                cause="Amplitude: the property is for small angles. With larger angles, a body slips less, and its "
                "speed approaches that of the wave.",
                effect=endless - 2.0,
                unit="1",
            ),
            DifferenceReason(
                cause="Amplitude: the body has a finite length, 10 straight links, mass and servos.",
                effect=chain_amplitude - endless,
                unit="1",
            ),
            DifferenceReason(
                cause="Amplitude: unknown, possibly contacts, and loads that are not constant.",
                effect=amplitude_exponent - chain_amplitude,
                unit="1",
            ),
            DifferenceReason(
                cause="Frequency: the body has mass and servos.",
                effect=chain_frequency - 1.0,
                unit="1",
            ),
            DifferenceReason(
                cause="Frequency: unknown, possibly contacts, and loads that are not constant.",
                effect=frequency_exponent - chain_frequency,
                unit="1",
            ),
        )
        return ExperimentFindings(
            comparisons=comparisons,
            reasons=reasons,
            picture=_make_picture(amplitudes_rad, by_amplitude),
        )


def _make_run(amplitude_rad: float, period_s: float) -> GaitRun:
    """Return a run of a sine in every joint."""
    settings = (
        f"robot.chain.modules={MODULES}",
        "controller=lateral_undulation",
        f"control.amplitude_rad={amplitude_rad:.6g}",
        f"control.lag_rad={LAG_RAD:.6g}",
        f"control.period_s={period_s:g}",
        *set_viscous(ALONG_S_PER_M, DRAG_RATIO * ALONG_S_PER_M),
    )
    return GaitRun(settings=settings, period_s=period_s)


def find_chain_speed(run: GaitRun, motion: GaitMotion) -> float:
    """Return the speed by the momentum balance, for the measured angles of the joints. Runs in a worker."""
    return find_chain_motion(
        run.robot, JointWaves(motion.angle_harmonics, run.period_s), run.friction
    ).speed_m_s


def _find_saturating_speed(amplitude_rad: float) -> float:
    """Return the speed of an endless body, as a fraction of that of the wave, to the second order of the angles.

        V / c = e / (1 + e), with e = 1/2 (r - 1) alpha^2

    Joints of the amplitude A with the lag delta make a curve with the winding angle alpha = A / (2 sin(delta / 2)).
    """
    winding_angle_rad = amplitude_rad / (2.0 * math.sin(LAG_RAD / 2.0))
    half_square = 0.5 * (DRAG_RATIO - 1.0) * winding_angle_rad**2
    return half_square / (1.0 + half_square)


def _make_picture(
    amplitudes_rad: Sequence[float], speeds_m_s: Sequence[float]
) -> ExperimentPicture:
    """Return the picture of the speed by amplitude, with a line of slope 2 through the first point."""
    degrees = [math.degrees(amplitude_rad) for amplitude_rad in amplitudes_rad]
    square = [speeds_m_s[0] * (amplitude / degrees[0]) ** 2 for amplitude in degrees]
    return ExperimentPicture(
        x_label="amplitude of the joints [degrees]",
        y_label="speed [m/s]",
        curves=(
            PictureCurve(label="proportional to the squared amplitude", x=degrees, y=square),
            PictureCurve(label="simulator", x=degrees, y=speeds_m_s, is_ours=True),
        ),
        is_logarithmic=True,
    )
