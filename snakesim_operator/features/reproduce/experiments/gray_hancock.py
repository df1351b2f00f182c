"""Gray and Hancock 1955: the speed of a filament that undulates in a viscous medium."""

import math

from snakesim_operator.features.reproduce.endless_curve import find_axis_ratio, find_endless_motion
from snakesim_operator.features.reproduce.experiment import (
    Experiment,
    ExperimentFindings,
    ExperimentPicture,
    PictureCurve,
    PublishedComparison,
    PublishedSource,
    explain_by_steps,
)
from snakesim_operator.features.reproduce.gait_motion import GaitMotion
from snakesim_operator.features.reproduce.planar_chain import (
    STEP_S,
    JointWaves,
    find_chain_motion,
)
from snakesim_operator.features.reproduce.trials import (
    ExperimentTrials,
    GaitRun,
    make_serpenoid_run,
    set_viscous,
)

WINDING_ANGLES_RAD = (0.15, 0.3, 0.45, 0.6)
COMPARED_RAD = 0.3
DRAG_RATIO = 2.0
WAVELENGTH = 1 / 3
PERIOD_S = 2.0
ACROSS_S_PER_M = 10.0
QUICK_STEP_S = 0.002  # of the chain; its speed differs by less than 1 % from that with STEP_S


def find_published_ratio(winding_angle_rad: float, drag_ratio: float) -> float:
    """Return the speed over the speed of the wave, both along the axis: b is the amplitude, k the wave number.

        V / c = 1/2 b^2 k^2 (C_N / C_L - 1) / (1 + 1/2 b^2 k^2 C_N / C_L)

    The steepest slope b k of a sine is the tangent of the winding angle.
    """
    half_square = 0.5 * math.tan(winding_angle_rad) ** 2
    return half_square * (drag_ratio - 1.0) / (1.0 + half_square * drag_ratio)


class GrayHancock(Experiment):
    """Speed of an undulating body on viscous ground."""

    name = "gray-hancock"
    source = PublishedSource(
        authors="J. Gray and G. J. Hancock",
        title="The propulsion of sea-urchin spermatozoa",
        published_in="Journal of Experimental Biology 32",
        year=1955,
        place="speed of a filament without a head, from normal and tangential drag",
        seen=(
            "The formula as other works quote it. We have not read the paper. The formula follows from the balance of "
            "drag along the axis, which a test confirms for small bends."
        ),
    )
    claim = (
        "A filament that bends in a sine wave travels at V = c b^2 k^2 (r - 1) / (2 + r b^2 k^2). Here b is the "
        "amplitude, k the wave number, c the speed of the wave, and r the ratio of normal to tangential drag."
    )
    published_conditions = "An endless filament, small bends, no inertia, and a ratio of 2."
    our_conditions = (
        "31 links of planar13, three waves on the body, and viscous ground with a ratio of 2."
    )
    method = "The speed of the center of mass along the body over two periods, after two periods that are not counted."

    def run(self, trials: ExperimentTrials) -> ExperimentFindings:
        """Measure the speed at several amplitudes."""
        angles_rad = (COMPARED_RAD,) if trials.is_quick else WINDING_ANGLES_RAD
        friction = set_viscous(ACROSS_S_PER_M / DRAG_RATIO, ACROSS_S_PER_M)
        runs = [
            make_serpenoid_run(angle_rad, WAVELENGTH, PERIOD_S, friction)
            for angle_rad in angles_rad
        ]
        motions = trials.measure(runs)
        ours = [
            _find_speed_ratio(motion, angle_rad)
            for motion, angle_rad in zip(motions, angles_rad, strict=True)
        ]
        compared = angles_rad.index(COMPARED_RAD)
        published = find_published_ratio(COMPARED_RAD, DRAG_RATIO)
        step_s = QUICK_STEP_S if trials.is_quick else STEP_S
        steps = _find_steps(runs[compared], motions[compared], step_s)
        comparison = PublishedComparison(
            quantity=f"speed over the speed of the wave, at a winding angle of {COMPARED_RAD:g} rad",
            unit="1",
            published=published,
            basis="formula",
            ours=ours[compared],
            runs=1,
        )
        dense_rad = [0.02 * i for i in range(1, 33)]
        picture = ExperimentPicture(
            x_label="winding angle [rad]",
            y_label="speed over the speed of the wave",
            curves=(
                PictureCurve(
                    label="formula",
                    x=dense_rad,
                    y=[find_published_ratio(angle_rad, DRAG_RATIO) for angle_rad in dense_rad],
                ),
                PictureCurve(label="simulator", x=angles_rad, y=ours, is_ours=True),
            ),
        )
        reasons = explain_by_steps(
            [("", published), *steps, ("", ours[compared])],
            unit="1",
            rest="contacts, and loads that are not constant",
        )
        return ExperimentFindings(comparisons=(comparison,), reasons=reasons, picture=picture)


def _find_wave_m_s(body_length_m: float, winding_angle_rad: float) -> float:
    """Return the speed of the wave along the axis."""
    return WAVELENGTH * body_length_m / PERIOD_S * find_axis_ratio(winding_angle_rad)


def _find_speed_ratio(motion: GaitMotion, winding_angle_rad: float) -> float:
    return motion.speed_m_s / _find_wave_m_s(motion.body_length_m, winding_angle_rad)


def _find_steps(run: GaitRun, motion: GaitMotion, step_s: float) -> list[tuple[str, float]]:
    """Return values between the formula and the simulator, each with what it adds.

    Args:
        run: The run of the simulator.
        motion: Its motion.
        step_s: Duration of a step of the chain.
    """
    robot = run.robot
    wave_m_s = _find_wave_m_s(robot.length_m, COMPARED_RAD)
    endless = find_endless_motion(COMPARED_RAD, run.friction).speed / find_axis_ratio(COMPARED_RAD)
    commanded = JointWaves.from_serpenoid(robot, COMPARED_RAD, WAVELENGTH, PERIOD_S)
    measured = JointWaves(motion.angle_harmonics, PERIOD_S)
    return [
        ("The bends are not small, and the curve is a serpenoid.", endless),
        (
            "The body has a finite length, 31 straight links, and mass.",
            find_chain_motion(robot, commanded, run.friction, step_s).speed_m_s / wave_m_s,
        ),
        (
            "The servos do not follow their targets exactly.",
            find_chain_motion(robot, measured, run.friction, step_s).speed_m_s / wave_m_s,
        ),
    ]
