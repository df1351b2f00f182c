"""Hu, Nirody, Scott and Shelley 2009: a snake on flat ground, with the friction measured on its scales."""

from snakesim_operator.features.reproduce.experiment import (
    Experiment,
    ExperimentFindings,
    ExperimentPicture,
    PictureCurve,
    PublishedComparison,
    PublishedSource,
    explain_by_steps,
)
from snakesim_operator.features.reproduce.planar_chain import JointWaves, find_chain_motion
from snakesim_operator.features.reproduce.trials import (
    ExperimentTrials,
    GaitRun,
    make_serpenoid_run,
    set_skin,
)

FORWARD = 0.11
BACKWARD = 0.14
SIDEWAYS = 0.19
SIDEWAYS_SWEEP = (0.14, 0.165, 0.19, 0.28, 0.44)
WINDING_ANGLE_RAD = 0.9
WAVELENGTH = 0.5
PERIOD_S = 2.0


class HuSlithering(Experiment):
    """Speed against the ratio of sideways to forward friction."""

    name = "hu-slithering"
    source = PublishedSource(
        authors="D. L. Hu, J. Nirody, T. Scott and M. J. Shelley",
        title="The mechanics of slithering locomotion",
        published_in="PNAS 106",
        year=2009,
        place="equation 1 and the law of sliding friction, with coefficients of milk snakes on cloth",
        seen=(
            "The abstract, equation 1, the law of sliding friction, and the coefficients as this project cites them. "
            "We have not read any table or figure, so we do not quote a measured speed of a snake."
        ),
    )
    claim = (
        "Friction acts on each piece of the body against its direction of sliding. It is the weight of the piece "
        "times 0.11 forward, 0.14 backward and 0.19 sideways. If the shape is prescribed, Newton's law gives the "
        "motion of the body."
    )
    published_conditions = (
        "A snake of evenly distributed weight, whose shape is prescribed, on cloth."
    )
    our_conditions = (
        "31 links of planar13, two waves of a serpenoid curve with a winding angle of 0.9 rad, and a period of 2 s. "
        "We have not read the curve of the paper, so its equations are solved for our curve."
    )
    method = (
        "The speed of the center of mass along the body over two periods, after two periods that are not counted. The "
        "equations are solved in the plane, without MuJoCo."
    )

    def run(self, trials: ExperimentTrials) -> ExperimentFindings:
        """Measure the speed with several coefficients sideways; forward and backward ones stay."""
        coefficients = (SIDEWAYS,) if trials.is_quick else SIDEWAYS_SWEEP
        runs = [_make_run(sideways) for sideways in coefficients]
        motions = trials.measure(runs)
        ours = [motion.speed_m_s / motion.body_length_m for motion in motions]
        solved = trials.call(solve_model, [(run,) for run in runs])
        compared = coefficients.index(SIDEWAYS)
        measured_waves = JointWaves(motions[compared].angle_harmonics, PERIOD_S)
        robot = runs[compared].robot
        with_measured = (
            find_chain_motion(robot, measured_waves, runs[compared].friction).speed_m_s
            / robot.length_m
        )
        unit = "body lengths/s"
        comparison = PublishedComparison(
            quantity="speed with 0.11 forward, 0.14 backward and 0.19 sideways",
            unit=unit,
            published=solved[compared],
            basis="model",
            ours=ours[compared],
            runs=1,
        )
        ratios = [sideways / FORWARD for sideways in coefficients]
        picture = ExperimentPicture(
            x_label="sideways over forward friction",
            y_label="speed [body lengths/s]",
            curves=(
                PictureCurve(label="equations of the paper", x=ratios, y=solved),
                PictureCurve(label="simulator", x=ratios, y=ours, is_ours=True),
            ),
        )
        reasons = explain_by_steps(
            [
                ("", solved[compared]),
                ("The servos do not follow their targets exactly.", with_measured),
                ("", ours[compared]),
            ],
            unit=unit,
            rest="contacts that stick before they slide, and loads that are not constant",
        )
        return ExperimentFindings(comparisons=(comparison,), reasons=reasons, picture=picture)


def _make_run(sideways: float) -> GaitRun:
    return make_serpenoid_run(
        WINDING_ANGLE_RAD, WAVELENGTH, PERIOD_S, set_skin(FORWARD, BACKWARD, sideways)
    )


def solve_model(run: GaitRun) -> float:
    """Return the speed by the equations of the paper, in body lengths per second. Runs in a worker."""
    waves = JointWaves.from_serpenoid(run.robot, WINDING_ANGLE_RAD, WAVELENGTH, PERIOD_S)
    return find_chain_motion(run.robot, waves, run.friction).speed_m_s / run.robot.length_m
