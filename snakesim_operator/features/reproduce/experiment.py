"""What every experiment states, and what it finds: the published number, ours, and the reasons for a difference."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import numpy as np

from snakesim_operator.features.reproduce.trials import ExperimentTrials

Basis = Literal["printed", "formula", "model"]
"""What a published value is: a value that the source prints, a formula of the source that we evaluate, or equations of
the source that we solve.
"""


@dataclass(frozen=True, kw_only=True)
class PublishedSource:
    """Where a published value is from."""

    authors: str
    title: str
    published_in: str
    year: int
    place: str  # figure, table, equation or section
    seen: str  # what we have read of it

    @property
    def short_text(self) -> str:
        """Return authors and title in one line."""
        return f"{self.authors}: {self.title}"


@dataclass(frozen=True, kw_only=True)
class PublishedComparison:
    """A published value and ours."""

    quantity: str
    unit: str  # "1" for a number without a unit, "" for a text
    published: float | str
    basis: Basis
    ours: float | str
    # 95 % of the mean over seeds; None: the result does not depend on it.
    interval: tuple[float, float] | None = None
    runs: int

    @property
    def difference(self) -> float | None:
        """Return ours minus the published value; None for texts."""
        if isinstance(self.published, str) or isinstance(self.ours, str):
            return None
        return self.ours - self.published

    @property
    def agrees(self) -> bool | None:
        """Return whether two texts are equal; None for numbers."""
        if isinstance(self.published, str) or isinstance(self.ours, str):
            return self.published == self.ours
        return None


@dataclass(frozen=True, kw_only=True)
class DifferenceReason:
    """A reason for a difference between the published value and ours."""

    cause: str
    effect: float | None = None  # on our value; None: known, but its size was not computed
    unit: str = ""


@dataclass(frozen=True, kw_only=True)
class PictureCurve:
    """A curve of the picture of an experiment."""

    label: str
    x: Sequence[float]
    y: Sequence[float]
    is_ours: bool = False  # drawn as points


@dataclass(frozen=True, kw_only=True)
class ExperimentPicture:
    """The picture of an experiment: curves over one quantity."""

    x_label: str
    y_label: str
    curves: Sequence[PictureCurve]
    is_logarithmic: bool = False


@dataclass(frozen=True, kw_only=True)
class ExperimentFindings:
    """What one experiment found."""

    comparisons: Sequence[PublishedComparison]
    reasons: Sequence[DifferenceReason]
    picture: ExperimentPicture
    notes: Sequence[str] = field(default=())


class Experiment(ABC):
    """A published experiment that our simulator repeats."""

    name: ClassVar[str]
    """What the command calls it."""

    source: ClassVar[PublishedSource]
    """Where the published value is from."""

    claim: ClassVar[str]
    """What is published, in one sentence."""

    published_conditions: ClassVar[str]
    """Conditions of the published experiment, as far as we have read them."""

    our_conditions: ClassVar[str]
    """Conditions of our runs."""

    method: ClassVar[str]
    """How our value is measured."""

    depends_on_seed: ClassVar[bool] = False
    """Whether noise of the sensors changes the motion. Gaits without feedback move alike with every seed."""

    @abstractmethod
    def run(self, trials: ExperimentTrials) -> ExperimentFindings:
        """Repeat the experiment.

        Args:
            trials: Runs configurations in the simulator. If `trials.is_quick`, fewer and shorter runs are enough.
        """


def explain_by_steps(
    values: Sequence[tuple[str, float]], unit: str, rest: str
) -> list[DifferenceReason]:
    """Return the reasons of a difference from values that come closer to the simulator step by step.

    Args:
        values: The published value first, with an empty text. Each further one has the cause of its difference from the
            one before. The last one is ours, and its cause is not known.
        unit: Unit of the values.
        rest: What may be the cause of the last difference.
    """
    reasons: list[DifferenceReason] = []
    previous = values[0][1]
    for cause, value in values[1:-1]:
        reasons.append(DifferenceReason(cause=cause, effect=value - previous, unit=unit))
        previous = value
    last = values[-1][1] - previous
    reasons.append(DifferenceReason(cause=f"Unknown, possibly {rest}.", effect=last, unit=unit))
    return reasons


def fit_exponent(x: Sequence[float], y: Sequence[float]) -> float:
    """Return the exponent p of y = c x^p, by least squares in logarithms."""
    exponent, _ = np.polyfit(np.log(x), np.log(y), 1)
    return float(exponent)
