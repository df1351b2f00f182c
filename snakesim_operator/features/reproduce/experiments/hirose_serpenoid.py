"""Hirose 1993: a snake on wheels that do not slip follows its serpenoid curve."""

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
from snakesim_operator.features.reproduce.planar_chain import JointWaves, find_chain_motion
from snakesim_operator.features.reproduce.trials import (
    ExperimentTrials,
    GaitRun,
    make_serpenoid_run,
)

WINDING_ANGLES_RAD = (0.3, 0.6, 0.9, 1.2)
COMPARED_RAD = 0.6
WAVELENGTH = 0.5
PERIOD_S = 2.0
WHEELS = (
    "robot.wheels.radius_m=0.03",
    "robot.wheels.bearing_radius_m=0.003",
    "robot.wheels.bearing_friction=0.1",
    "robot.wheels.tire_friction=0.6",
)


class HiroseSerpenoid(Experiment):
    """Speed of a serpenoid curve on wheels."""

    name = "hirose-serpenoid"
    source = PublishedSource(
        authors="S. Hirose",
        title="Biologically Inspired Robots: Snake-Like Locomotors and Manipulators",
        published_in="Oxford University Press",
        year=1993,
        place="serpenoid curve, whose length along the axis is J0(alpha) times that of the body",
        seen=(
            "The curve as other works quote it. We have not read the book. The ratio of the lengths is the mean of "
            "cos(alpha cos phase), which is a Bessel function."
        ),
    )
    claim = (
        "A snake whose wheels do not slip sideways moves along its own curve. So it travels one wave in each period: "
        "V = J0(alpha) lambda L / T, with the winding angle alpha and the length lambda L of a wave along the body."
    )
    published_conditions = "A continuous body that does not slip sideways."
    our_conditions = (
        "31 links of planar13, two waves on the body, wheels with a tire friction of 0.6, and bearings that brake "
        "with 1 % of the weight."
    )
    method = "The speed of the center of mass along the body over two periods, after two periods that are not counted."

    def run(self, trials: ExperimentTrials) -> ExperimentFindings:
        """Measure the speed at several winding angles."""
        angles_rad = (COMPARED_RAD,) if trials.is_quick else WINDING_ANGLES_RAD
        runs = [
            make_serpenoid_run(angle_rad, WAVELENGTH, PERIOD_S, WHEELS) for angle_rad in angles_rad
        ]
        motions = trials.measure(runs)
        ours = [motion.speed_m_s for motion in motions]
        compared = angles_rad.index(COMPARED_RAD)
        wave_m_s = _find_wave_m_s(runs[0])
        published = wave_m_s * find_axis_ratio(COMPARED_RAD)
        comparison = PublishedComparison(
            quantity=f"speed at a winding angle of {COMPARED_RAD:g} rad",
            unit="m/s",
            published=published,
            basis="formula",
            ours=ours[compared],
            runs=1,
        )
        dense_rad = [0.05 * i for i in range(1, 27)]
        picture = ExperimentPicture(
            x_label="winding angle [rad]",
            y_label="speed [m/s]",
            curves=(
                PictureCurve(
                    label="without slip: J0",
                    x=dense_rad,
                    y=[wave_m_s * find_axis_ratio(angle_rad) for angle_rad in dense_rad],
                ),
                PictureCurve(
                    label="endless body that slips",
                    x=dense_rad,
                    y=[
                        wave_m_s * find_endless_motion(angle_rad, runs[0].friction).speed
                        for angle_rad in dense_rad
                    ],
                ),
                PictureCurve(label="simulator", x=angles_rad, y=ours, is_ours=True),
            ),
        )
        steps = _find_steps(runs[compared], motions[compared], wave_m_s)
        reasons = explain_by_steps(
            [("", published), *steps, ("", ours[compared])],
            unit="m/s",
            rest="contacts, and loads that are not constant",
        )
        return ExperimentFindings(comparisons=(comparison,), reasons=reasons, picture=picture)


def _find_wave_m_s(run: GaitRun) -> float:
    """Return the speed of the wave along the body."""
    return WAVELENGTH * run.robot.length_m / PERIOD_S


def _find_steps(run: GaitRun, motion: GaitMotion, wave_m_s: float) -> list[tuple[str, float]]:
    """Return values between the formula and the simulator, each with what it adds."""
    robot = run.robot
    commanded = JointWaves.from_serpenoid(robot, COMPARED_RAD, WAVELENGTH, PERIOD_S)
    measured = JointWaves(motion.angle_harmonics, PERIOD_S)
    return [
        (
            "The wheels brake the body and slip sideways.",
            wave_m_s * find_endless_motion(COMPARED_RAD, run.friction).speed,
        ),
        (
            "The body has a finite length, 31 straight links, and mass.",
            find_chain_motion(robot, commanded, run.friction).speed_m_s,
        ),
        (
            "The servos do not follow their targets exactly.",
            find_chain_motion(robot, measured, run.friction).speed_m_s,
        ),
    ]
