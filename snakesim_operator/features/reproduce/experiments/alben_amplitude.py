"""Alben 2013: the amplitude of the wave that travels with the least work, for large transverse friction."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from snakesim_hal.model.friction import DirectionalFriction
from snakesim_operator.features.reproduce.endless_curve import find_endless_motion
from snakesim_operator.features.reproduce.experiment import (
    Comparison,
    Curve,
    Experiment,
    Findings,
    Picture,
    Reason,
    Source,
    fit_exponent,
)
from snakesim_operator.features.reproduce.gait_motion import GaitMotion, GroundFriction
from snakesim_operator.features.reproduce.trials import NO_SEEDS, GaitRun, Trials, make_serpenoid_run, set_skin

RATIOS = (10.0, 20.0, 40.0, 80.0)  # of transverse to forward friction
FACTORS = (0.64, 0.8, 1.0, 1.25, 1.5)  # of the amplitudes that are tried, around the expected optimum
SIDEWAYS = 1.0
WAVELENGTH = 0.5
PERIOD_S = 3.0


class AlbenAmplitude(Experiment):
    """Exponent of the optimal amplitude in the transverse friction."""

    name = "alben-amplitude"
    source = Source(
        authors="S. Alben",
        title="Optimizing snake locomotion in the plane",
        published_in="Proceedings of the Royal Society A 469",
        year=2013,
        place="abstract",
        seen="Abstract and introduction.",
    )
    claim = (
        "For large transverse friction, the wave that travels with the least work is retrograde, and its optimal "
        "amplitude decays as the power -1/4 of the coefficient of transverse friction."
    )
    published_conditions = (
        "A slender body whose curvature is prescribed, with dry friction in the plane, for large coefficients."
    )
    our_conditions = (
        "31 links of planar13, and two waves of a serpenoid curve with a period of 3 s. The coefficient is 1 across "
        "the body, and 1/10 to 1/80 along it in both directions."
    )
    method = (
        "Work against friction per distance at five amplitudes for each ratio, and the minimum of a cubic through "
        f"them in logarithms. The exponent is that of the winding angles at the minima, by least squares. {NO_SEEDS}"
    )

    def run(self, trials: Trials) -> Findings:
        """Measure the work per distance at several amplitudes and ratios."""
        ratios = RATIOS[1:3] if trials.is_quick else RATIOS
        cases = [(ratio, factor * _expect_optimum_rad(ratio)) for ratio in ratios for factor in FACTORS]
        motions = trials.measure([_make_run(ratio, angle_rad) for ratio, angle_rad in cases])
        costs = [_find_cost(motion, ratio) for motion, (ratio, _) in zip(motions, cases, strict=True)]
        ours = [
            _find_minimum(angles_rad, costs[i * len(FACTORS) : (i + 1) * len(FACTORS)])
            for i, angles_rad in enumerate(_tried_angles_rad(ratio) for ratio in ratios)
        ]
        endless = [_find_minimum(_tried_angles_rad(ratio), _find_endless_costs(ratio)) for ratio in ratios]
        exponent = fit_exponent(ratios, ours)
        endless_exponent = fit_exponent(ratios, endless)
        comparison = Comparison(
            quantity="exponent of the optimal amplitude",
            unit="1",
            published=-0.25,
            basis="printed",
            ours=exponent,
            runs=len(cases),
        )
        reasons = (
            Reason(
                cause="The coefficients are not infinite, and the curve is a serpenoid.",
                effect=endless_exponent + 0.25,
                unit="1",
            ),
            Reason(
                cause="The body ends, and has 31 straight links, mass and servos. Their parts are unknown.",
                effect=exponent - endless_exponent,
                unit="1",
            ),
        )
        picture = Picture(
            x_label="transverse over forward friction",
            y_label="optimal winding angle [rad]",
            curves=(
                _make_curve("power -1/4, from our derivation", ratios, _expect_optimum_rad),
                Curve(label="endless body", x=ratios, y=endless),
                Curve(label="simulator", x=ratios, y=ours, is_ours=True),
            ),
            is_logarithmic=True,
        )
        return Findings(comparisons=(comparison,), reasons=reasons, picture=picture)


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
    return make_serpenoid_run(winding_angle_rad, WAVELENGTH, PERIOD_S, set_skin(along, along, SIDEWAYS))


def _find_cost(motion: GaitMotion, ratio: float) -> float:
    """Return the work against friction per distance, over that of dragging the straight body forward."""
    return motion.ground_power_w / (motion.speed_m_s * motion.weight_n * SIDEWAYS / ratio)


def _find_endless_costs(ratio: float) -> list[float]:
    along = SIDEWAYS / ratio
    friction = GroundFriction(DirectionalFriction(along, along, SIDEWAYS), 0.0, 0.0)
    return [find_endless_motion(angle_rad, friction).cost for angle_rad in _tried_angles_rad(ratio)]


def _find_minimum(angles_rad: Sequence[float], costs: Sequence[float]) -> float:
    """Return the angle at the minimum of a cubic through costs, in logarithms."""
    logarithms = np.log(angles_rad)
    cubic = np.polyfit(logarithms, np.log(costs), 3)
    dense = np.linspace(logarithms[0], logarithms[-1], 2001)
    return math.exp(dense[np.argmin(np.polyval(cubic, dense))])


def _make_curve(label: str, ratios: Sequence[float], function: Callable[[float], float]) -> Curve:
    return Curve(label=label, x=ratios, y=[function(ratio) for ratio in ratios])
