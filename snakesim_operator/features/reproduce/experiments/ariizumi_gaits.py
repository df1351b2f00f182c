"""Ariizumi and Matsuno 2017: which of three gaits needs the least energy, by the anisotropy of friction."""

from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_operator.features.reproduce.experiment import (
    DifferenceReason,
    Experiment,
    ExperimentFindings,
    ExperimentPicture,
    PictureCurve,
    PublishedComparison,
    PublishedSource,
)
from snakesim_operator.features.reproduce.trials import ExperimentTrials, make_config
from snakesim_operator.run.in_process import simulate

DURATION_S = 8
RATIOS = (1.0, 2.0, 5.0, 10.0)  # of sideways to forward friction
NO_TORQUE_LIMIT_NM = 30.0  # ten times that of Mamba; no joint needs it
CONTROLLERS = {  # and the settings of each
    "lateral undulation": ("controller=serpenoid", "control.k_theta=0"),
    "sidewinding": ("controller=backbone_sidewinding",),
    "sinus-lifting": ("controller=sinus_lifting",),
}


@dataclass(frozen=True)
class GaitOnGround:
    """A gait on ground with some friction."""

    gait: str  # one of CONTROLLERS
    ratio: float  # of sideways to forward friction
    torque_limit_nm: float | None = None  # of all joints; None: that of Mamba


@dataclass(frozen=True)
class GaitEnergy:
    """Energy of one run."""

    j_per_m: float | None  # along the displacement; None: it moved less than 0.1 m
    saturated_fraction: float  # of the time in which a joint is at its torque limit


class AriizumiGaits(Experiment):
    """Order of three gaits by energy."""

    name = "ariizumi-gaits"
    source = PublishedSource(
        authors="R. Ariizumi and F. Matsuno",
        title="Dynamic Analysis of Three Snake Robot Gaits",
        published_in="IEEE Transactions on Robotics 33",
        year=2017,
        place="abstract",
        seen="The abstract, in a copy of the manuscript. We have not read the parameters and the diagrams.",
    )
    claim = (
        "If the anisotropy in friction is large enough, sinus-lifting is the most energy efficient gait. Otherwise "
        "sidewinding is. Both are generally more efficient than lateral undulation."
    )
    published_conditions = (
        "Planar models of a robot, eight settings of friction, and the trade-off "
        "between speed and energy."
    )
    our_conditions = (
        "Mamba with 18 joints on flat ground with a friction of 0.6 sideways. Friction is the same forward and "
        "backward. Each gait has its default parameters, and its own speed."
    )
    method = (
        "The energy of all joints (the sum of |torque x speed|), divided by the distance of the center of mass in 8 "
        "s. The value is the mean over several seeds of the sensor noise. A gait that moves less than 0.1 m has no "
        "value."
    )
    depends_on_seed = True

    def run(self, trials: ExperimentTrials) -> ExperimentFindings:
        """Run the gaits at several ratios of friction, and sinus-lifting with strong motors too."""
        ratios = (RATIOS[0], RATIOS[-1]) if trials.is_quick else RATIOS
        seeds = range(1, (1 if trials.is_quick else trials.seeds) + 1)
        cases = [GaitOnGround(gait, ratio) for gait in CONTROLLERS for ratio in ratios]
        cases.append(GaitOnGround("sinus-lifting", ratios[-1], NO_TORQUE_LIMIT_NM))
        energies: list[GaitEnergy] = trials.call(
            run_trial, [(case, seed) for case in cases for seed in seeds]
        )
        found: dict[GaitOnGround, list[GaitEnergy]] = {}
        for i, case in enumerate(cases):
            found[case] = energies[i * len(seeds) : (i + 1) * len(seeds)]
        means = {case: _find_mean(runs) for case, runs in found.items()}

        comparisons = tuple(
            PublishedComparison(
                quantity=f"gait with the least energy per meter, {text}",
                unit="",
                published=published,
                basis="printed",
                ours=_find_cheapest(
                    {gait: means[GaitOnGround(gait, ratio)] for gait in CONTROLLERS}
                ),
                runs=len(CONTROLLERS) * len(seeds),
            )
            for text, published, ratio in (
                ("equal friction in all directions", "sidewinding", ratios[0]),
                ("ten times the friction sideways", "sinus-lifting", ratios[-1]),
            )
        )
        curves: list[PictureCurve] = []
        for gait in CONTROLLERS:
            known = [(ratio, means[GaitOnGround(gait, ratio)]) for ratio in ratios]
            pairs = [(ratio, value) for ratio, value in known if value is not None]
            curves.append(
                PictureCurve(
                    label=gait,
                    x=[ratio for ratio, _ in pairs],
                    y=[value for _, value in pairs],
                    is_ours=True,
                )
            )
        picture = ExperimentPicture(
            x_label="sideways over forward friction",
            y_label="energy [J/m]",
            curves=curves,
            is_logarithmic=True,
        )
        notes = tuple(
            _describe(gait, {ratio: means[GaitOnGround(gait, ratio)] for ratio in ratios})
            for gait in CONTROLLERS
        )
        return ExperimentFindings(
            comparisons=comparisons,
            reasons=_find_reasons(found, means, ratios[-1]),
            picture=picture,
            notes=notes,
        )


def run_trial(case: GaitOnGround, seed: int) -> GaitEnergy:
    """Run a gait with a seed of the sensors' noise, and return its energy. Runs in a worker."""
    settings = [
        *CONTROLLERS[case.gait],
        f"duration_s={DURATION_S}",
        f"seed={seed}",
        f"robot.skin.forward={1.0 / case.ratio:g}",
        f"robot.skin.backward={1.0 / case.ratio:g}",
        "robot.skin.sideways=1",
    ]
    if case.torque_limit_nm is not None:
        settings.append(f"robot.limits.torque_nm={case.torque_limit_nm:g}")
    summary = simulate(make_config("mamba_flat", settings)).summary
    return GaitEnergy(summary.displacement_energy_j_per_m, summary.torque_saturated_fraction or 0.0)


def _find_mean(runs: Sequence[GaitEnergy]) -> float | None:
    """Return the mean energy per meter; None if a run has none."""
    values = [run.j_per_m for run in runs if run.j_per_m is not None]
    if len(values) < len(runs):
        return None
    return sum(values) / len(values)


def _find_cheapest(energies: dict[str, float | None]) -> str:
    """Return the gait with the least energy per meter."""
    known = {gait: value for gait, value in energies.items() if value is not None}
    return min(known, key=lambda gait: known[gait]) if known else "none"


def _describe(gait: str, energies: dict[float, float | None]) -> str:
    """Return the energies of a gait in one sentence."""
    parts: list[str] = []
    for ratio, value in energies.items():
        energy = "less than 0.1 m" if value is None else f"{value:.0f} J/m"
        parts.append(f"{energy} at {ratio:g}")
    return f"{gait.capitalize()}, by the ratio of sideways to forward friction: {', '.join(parts)}."


def _find_reasons(
    found: dict[GaitOnGround, list[GaitEnergy]],
    means: dict[GaitOnGround, float | None],
    ratio: float,
) -> tuple[DifferenceReason, ...]:
    """Return why the order differs at a large anisotropy."""
    shipped_case = GaitOnGround("sinus-lifting", ratio)
    shipped = means[shipped_case]
    strong = means[GaitOnGround("sinus-lifting", ratio, NO_TORQUE_LIMIT_NM)]
    effect = None if shipped is None or strong is None else shipped - strong
    runs = found[shipped_case]
    saturated = sum(run.saturated_fraction for run in runs) / len(runs)
    return (
        DifferenceReason(
            cause=f"A joint of Mamba is at its torque limit in {100 * saturated:.0f} % of the time in sinus-lifting. "
            "Motors without that limit need this much less energy.",
            effect=effect,
            unit="J/m",
        ),
        DifferenceReason(
            cause="The paper studies the trade-off between speed and energy. Our gaits have one set of parameters "
            "each, and different speeds."
        ),
        DifferenceReason(
            cause="The abstract does not print how large the anisotropy has to be. Ten is our choice."
        ),
        DifferenceReason(
            cause="We have not read the masses, lengths and motors of the paper's robot."
        ),
    )
