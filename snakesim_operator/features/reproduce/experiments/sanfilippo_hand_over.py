"""Sanfilippo, Stavdahl and Liljebäck: which joints propel the snake of SnakeSIM's own paper, one after the other."""

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
from snakesim_operator.results.metrics.propulsion import find_propulsion_periods
from snakesim_operator.results.time_axis import get_time_origin_s
from snakesim_operator.run.in_process import simulate

DURATION_S = 10
PUBLISHED_ORDER = ("joint_7", "joint_6", "joint_5", "joint_4")
FORCE_N = 35.0
TAIL_LOST = "the obstacle at the tail is lost"
MAX_TAIL_M = 0.055  # length of the tail link of planar13


@dataclass(frozen=True)
class HandOverTrial:
    """Which joints propelled in one run."""

    joints: list[str]  # in order of use
    starts_s: list[float]  # on the time axis of the run
    end_s: float  # of the last one
    tail_m: float  # from the tail end to the push-point nearest to it, when propulsion ended


class SanfilippoHandOver(Experiment):
    """Order in which joints propel."""

    name = "sanfilippo-hand-over"
    source = PublishedSource(
        authors="F. Sanfilippo, Ø. Stavdahl and P. Liljebäck",
        title="SnakeSIM: a ROS-based Control and Simulation Framework for Perception-Driven Obstacle-Aided Locomotion "
        "of Snake Robots",
        published_in="the paper that SnakeSIM is based on",
        year=2018,
        place="section V, Figures 12 and 13",
        seen="The text of the paper. We have not read the curves of the figures. Our copy does not contain the year.",
    )
    claim = (
        "Propulsion passes from joint 7 to joints 6, 5 and 4, backward along the body, until the snake loses contact "
        "with the obstacle at its tail."
    )
    published_conditions = (
        "10 s, a propulsion force of 35 N, and three obstacles on alternating sides. One joint is controlled by "
        "torque, and all others by position. Sizes, masses and friction are not printed."
    )
    our_conditions = "Scenario triplet with 35 N and 10 s, 13 joints 0.11 m apart, and dry friction of the ground."
    method = (
        "The joints that control reports as propulsion joints, for several seeds of the sensor noise. The order is "
        "compared from joint 7 on. If a seed gives another order, this order is printed as well."
    )
    depends_on_seed = True

    def run(self, trials: ExperimentTrials) -> ExperimentFindings:
        """Run the case study with several seeds."""
        seeds = range(1, (1 if trials.is_quick else trials.seeds) + 1)
        found: list[HandOverTrial] = trials.call(run_trial, [(seed,) for seed in seeds])
        tail_m = sum(trial.tail_m for trial in found) / len(found)
        comparisons = (
            PublishedComparison(
                quantity="order of the propelling joints, from joint 7 on",
                unit="",
                published=_describe_joints(PUBLISHED_ORDER),
                basis="printed",
                ours=_describe_orders([_take_from_published(trial.joints) for trial in found]),
                runs=len(found),
            ),
            PublishedComparison(
                quantity="how propulsion ends",
                unit="",
                published=TAIL_LOST,
                basis="printed",
                ours=_describe_endings(found),
                runs=len(found),
            ),
        )
        reasons = (
            DifferenceReason(
                cause="Our order begins earlier, with "
                + _describe_orders([_take_before_published(trial.joints) for trial in found])
                + ", because our snake starts with its push-points further ahead. The paper does not print the start"
            ),
        )
        notes = (
            f"The propulsion force of {FORCE_N:g} N is a setting in both experiments, and not a result. The times in "
            "the figures are not compared, because we have not read the curves.",
            f"When propulsion ends, the obstacle is {1000 * tail_m:.0f} mm ahead of the end of the tail on average. "
            "The tail can then no longer press on it.",
        )
        return ExperimentFindings(
            comparisons=comparisons, reasons=reasons, picture=_make_picture(found), notes=notes
        )


def run_trial(seed: int) -> HandOverTrial:
    """Run the case study with a seed. Runs in a worker."""
    settings = (f"duration_s={DURATION_S}", f"seed={seed}", f"control.propulsion_n={FORCE_N:g}")
    record = simulate(make_config("triplet", settings)).record
    periods = find_propulsion_periods(record)
    names = [joint.name for joint in record.description.joints]
    end_s = periods[-1].end_s
    tail_m = float("nan")
    for state in record.control_states:
        time_s = state.timestamp_ns * 1e-9 - get_time_origin_s(record)
        if state.push_points and time_s <= end_s:
            tail_m = min(point.body_s_m for point in state.push_points)
    return HandOverTrial(
        joints=[names[period.joint_index] for period in periods],
        starts_s=[period.start_s for period in periods],
        end_s=end_s,
        tail_m=tail_m,
    )


def _take_from_published(joints: Sequence[str]) -> list[str]:
    """Return the joints from the first published one on; all, if it never propelled."""
    first = PUBLISHED_ORDER[0]
    return list(joints[joints.index(first) :]) if first in joints else list(joints)


def _take_before_published(joints: Sequence[str]) -> list[str]:
    """Return the joints before the first published one; none, if it never propelled."""
    first = PUBLISHED_ORDER[0]
    return list(joints[: joints.index(first)]) if first in joints else []


def _describe_joints(joints: Sequence[str]) -> str:
    return ", ".join(name.removeprefix("joint_") for name in joints) or "none"


def _describe_orders(orders: Sequence[Sequence[str]]) -> str:
    """Return the order of all runs, or each order with its number of runs."""
    texts = [_describe_joints(joints) for joints in orders]
    different = list(dict.fromkeys(texts))
    if len(different) == 1:
        return different[0]
    return "; ".join(f"{text} in {texts.count(text)} of {len(texts)}" for text in different)


def _describe_endings(found: Sequence[HandOverTrial]) -> str:
    """Return whether propulsion ended with an obstacle at the tail link, in all runs or in how many."""
    count = sum(trial.tail_m <= MAX_TAIL_M for trial in found)
    return TAIL_LOST if count == len(found) else f"{TAIL_LOST} in {count} of {len(found)} runs"


def _make_picture(found: Sequence[HandOverTrial]) -> ExperimentPicture:
    """Return the picture of the propelling joint over time, one curve for each seed."""
    curves: list[PictureCurve] = []
    for seed, trial in enumerate(found, start=1):
        times_s: list[float] = []
        numbers: list[float] = []
        ends_s = [*trial.starts_s[1:], trial.end_s]
        for name, start_s, end_s in zip(trial.joints, trial.starts_s, ends_s, strict=True):
            number = float(name.removeprefix("joint_"))
            times_s += [start_s, end_s]
            numbers += [number, number]
        curves.append(PictureCurve(label=f"simulator, seed {seed}", x=times_s, y=numbers))
    return ExperimentPicture(x_label="time [s]", y_label="propelling joint", curves=curves)
