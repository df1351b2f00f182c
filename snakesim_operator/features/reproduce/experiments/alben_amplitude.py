"""Alben 2013: the amplitude of the wave that travels with the least work, for large transverse friction."""

import math
from collections.abc import Sequence

import numpy as np

from snakesim_hal.model.scene_file.friction import DirectionalFriction
from snakesim_hal.model.scene_file.solids import GRAVITY_M_S2
from snakesim_operator.features.reproduce.endless_curve import find_endless_motion
from snakesim_operator.features.reproduce.experiment import (
    Experiment,
    ExperimentFindings,
    ExperimentPicture,
    PictureCurve,
    PublishedComparison,
    PublishedSource,
    explain_by_steps,
    fit_exponent,
)
from snakesim_operator.features.reproduce.gait_motion import GaitMotion, GroundFriction
from snakesim_operator.features.reproduce.planar_chain import JointWaves, find_chain_motion
from snakesim_operator.features.reproduce.trials import (
    ExperimentTrials,
    GaitRun,
    make_serpenoid_run,
    set_skin,
)

RATIOS = (20.0, 40.0, 80.0, 160.0)  # of transverse to forward friction
# Of the amplitudes that are tried, around the expected optimum.
FACTORS = 0.64, 0.8, 1.0, 1.25, 1.5
SIDEWAYS = 1.0
PUBLISHED_EXPONENT = -0.25
WAVELENGTH = 0.5
PERIOD_S = 3.0


class AlbenAmplitude(Experiment):
    """Exponent of the optimal amplitude in the transverse friction."""

    name = "alben-amplitude"
    source = PublishedSource(
        authors="S. Alben",
        title="Optimizing snake locomotion in the plane",
        published_in="Proceedings of the Royal Society A 469",
        year=2013,
        place="abstract, and that of the preprint arXiv:1304.4479, which has deflection",
        seen="The abstract and the introduction of both.",
    )
    claim = (
        "For large transverse friction, the wave that travels with the least work is retrograde, and its optimal "
        "deflection decays as the power -1/4 of the coefficient of transverse friction."
    )
    published_conditions = (
        "A slender body whose curvature is prescribed, with dry friction in the plane, "
        "for large coefficients."
    )
    our_conditions = (
        "31 links of planar13, and two waves of a serpenoid curve with a period of 3 s. The coefficient is 1 across "
        "the body, and 1/20 to 1/160 along it in both directions."
    )
    method = (
        "For each ratio, the work against friction per distance is computed at five amplitudes, from the measured "
        "motion of the links and the law of friction. The minimum of a cubic through these values, in logarithms, "
        "gives the best amplitude. A least-squares fit of the deflections at these minima gives the exponent."
    )

    def run(self, trials: ExperimentTrials) -> ExperimentFindings:
        """Measure the work per distance at several amplitudes and ratios."""
        ratios = RATIOS[1:3] if trials.is_quick else RATIOS
        cases = [(ratio, angle_rad) for ratio in ratios for angle_rad in _tried_angles_rad(ratio)]
        motions = trials.measure([_make_run(ratio, angle_rad) for ratio, angle_rad in cases])
        costs = [
            _find_cost(motion, ratio) for motion, (ratio, _) in zip(motions, cases, strict=True)
        ]
        ours = _find_optima(ratios, costs)
        endless_costs = [_find_endless_cost(ratio, angle_rad) for ratio, angle_rad in cases]
        endless = _find_optima(ratios, endless_costs)
        exponent = fit_exponent(ratios, ours)
        steps = [
            ("", PUBLISHED_EXPONENT),
            (
                "The coefficients are not infinite, and the curve is a serpenoid.",
                fit_exponent(ratios, endless),
            ),
        ]
        if not trials.is_quick:
            chain_costs = trials.call(find_chain_cost, cases)
            steps.append(
                (
                    "The body has a finite length, 31 straight links, and mass.",
                    fit_exponent(ratios, _find_optima(ratios, chain_costs)),
                )
            )
        steps.append(("", exponent))
        comparison = PublishedComparison(
            quantity="exponent of the optimal deflection",
            unit="1",
            published=PUBLISHED_EXPONENT,
            basis="printed",
            ours=exponent,
            runs=len(cases),
        )
        picture = ExperimentPicture(
            x_label="transverse over forward friction",
            y_label="optimal deflection [body lengths]",
            curves=(
                PictureCurve(
                    label="power -1/4, from our derivation",
                    x=ratios,
                    y=[
                        WAVELENGTH / (2.0 * math.pi) * _expect_optimum_rad(ratio)
                        for ratio in ratios
                    ],
                ),
                PictureCurve(label="endless body", x=ratios, y=endless),
                PictureCurve(label="simulator", x=ratios, y=ours, is_ours=True),
            ),
            is_logarithmic=True,
        )
        reasons = explain_by_steps(
            steps, unit="1", rest="servos, contacts, and the fit of the minima"
        )
        return ExperimentFindings(comparisons=(comparison,), reasons=reasons, picture=picture)


def find_deflection(winding_angle_rad: float) -> float:
    """Return the greatest distance of the serpenoid curve from its axis, in body lengths."""
    quarter = np.linspace(0.0, 0.5 * math.pi, 1001)
    heights = np.sin(winding_angle_rad * np.cos(quarter))
    return WAVELENGTH / (2.0 * math.pi) * float(np.trapezoid(heights, quarter))


def find_chain_cost(ratio: float, winding_angle_rad: float) -> float:
    """Return the cost of a chain whose joints follow the curve exactly, without MuJoCo. Runs in a worker."""
    run = _make_run(ratio, winding_angle_rad)
    waves = JointWaves.from_serpenoid(run.robot, winding_angle_rad, WAVELENGTH, PERIOD_S)
    motion = find_chain_motion(run.robot, waves, run.friction)
    weight_n = GRAVITY_M_S2 * sum(run.robot.link_masses_kg)
    return motion.ground_power_w / (motion.speed_m_s * weight_n * SIDEWAYS / ratio)


def _expect_optimum_rad(ratio: float) -> float:
    """Return the winding angle of least work for a large ratio of the coefficients.

    With the slip w and the winding angle alpha both small, the balance along the axis gives w = 2 / (ratio alpha^2).
    The work per distance, over that of dragging the body, is 1 + alpha^2 / 4 + 2 / (ratio alpha^2). Its minimum is at
    alpha^2 = sqrt(8 / ratio).
    """
    return (8.0 / ratio) ** 0.25


def _tried_angles_rad(ratio: float) -> list[float]:
    return [factor * _expect_optimum_rad(ratio) for factor in FACTORS]


def _make_run(ratio: float, winding_angle_rad: float) -> GaitRun:
    along = SIDEWAYS / ratio
    return make_serpenoid_run(
        winding_angle_rad, WAVELENGTH, PERIOD_S, set_skin(along, along, SIDEWAYS)
    )


def _find_cost(motion: GaitMotion, ratio: float) -> float:
    """Return the work against friction per distance, over that of dragging the straight body forward."""
    return motion.ground_power_w / (motion.speed_m_s * motion.weight_n * SIDEWAYS / ratio)


def _find_endless_cost(ratio: float, winding_angle_rad: float) -> float:
    """Return the cost of a body of endless length without inertia."""
    along = SIDEWAYS / ratio
    friction = GroundFriction(DirectionalFriction(along, along, SIDEWAYS), 0.0, 0.0)
    return find_endless_motion(winding_angle_rad, friction).cost


def _find_optima(ratios: Sequence[float], costs: Sequence[float]) -> list[float]:
    """Return the deflection of least cost for each ratio.

    Args:
        ratios: Ratios of the coefficients.
        costs: Cost of each angle that is tried, ratio by ratio.
    """
    count = len(FACTORS)
    return [
        find_deflection(_find_minimum(_tried_angles_rad(ratio), costs[i * count : (i + 1) * count]))
        for i, ratio in enumerate(ratios)
    ]


def _find_minimum(angles_rad: Sequence[float], costs: Sequence[float]) -> float:
    """Return the angle at the minimum of a cubic through costs, in logarithms."""
    logarithms = np.log(angles_rad)
    cubic = np.polyfit(logarithms, np.log(costs), 3)
    dense = np.linspace(logarithms[0], logarithms[-1], 2001)
    return math.exp(dense[np.argmin(np.polyval(cubic, dense))])
