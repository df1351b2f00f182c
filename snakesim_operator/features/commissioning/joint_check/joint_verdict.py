"""The verdict on one joint of a joint check: for each of its properties, whether it matches the robot file."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

from snakesim_hal.model.robot_file.checked import PROPERTIES, JointProperty

MATCHES_FILE = "matches the robot file"
PropertyState = Literal["confirmed", "wrong", "unknown"]


@dataclass(frozen=True)
class PropertyFinding:
    """Whether one property of a joint matches the robot file."""

    state: PropertyState
    # What is wrong and what to write, or why it is unknown and how it could be confirmed.
    reason: str = ""
    by_hand: bool = False  # confirmed by a person
    by_shape: bool = False  # confirmed by drawn shapes
    # Of a gear: the torque excludes more backlash than is allowed, so that only its ratio is unknown.
    excludes_backlash: bool = False


CONFIRMED = PropertyFinding("confirmed")


@dataclass(frozen=True)
class JointVerdict:
    """The findings on one joint."""

    joint: str
    findings: Mapping[JointProperty, PropertyFinding]
    moved_rad: float | None = None  # by its encoder; None if it was not moved
    turned: float | None = None  # motion of the links divided by it; None if unknown
    torque_nm: float | None = None  # mean along the motion; None if not measured

    def list_properties(self, state: PropertyState) -> list[JointProperty]:
        """Return the properties in this state."""
        return [name for name in PROPERTIES if self.findings[name].state == state]

    @property
    def all_confirmed(self) -> bool:
        """Whether every property was confirmed."""
        return len(self.list_properties("confirmed")) == len(PROPERTIES)

    @property
    def summary(self) -> str:
        """What is wrong; otherwise what is unknown; otherwise that it matches the file."""
        wrong = self.list_properties("wrong")
        if wrong:
            return "; ".join(self.findings[name].reason for name in wrong)
        unknown = self.list_properties("unknown")
        if unknown:
            return f"unknown: {', '.join(unknown)}"
        return MATCHES_FILE

    def confirm_by_hand(self, properties: Iterable[JointProperty]) -> "JointVerdict":
        """Return a copy in which a person has confirmed those of the properties that were unknown.

        Args:
            properties: The properties that the person confirms; a property that was judged wrong stays wrong.
        """
        return self._confirm_unknown(properties, PropertyFinding("confirmed", by_hand=True))

    def confirm_by_shape(
        self, properties: Iterable[JointProperty], *, was_shaken: bool
    ) -> "JointVerdict":
        """Return a copy in which drawn shapes have confirmed those of the properties that were unknown.

        Drawn shapes show only the ratio of a gear. So a gear is confirmed only if its backlash is excluded as well: by
        its torque in the check, or by a person.

        Args:
            properties: The properties that drawn shapes confirmed.
            was_shaken: Whether a person shook the link, and found no backlash.
        """
        is_gear_tight = was_shaken or self.findings["gear"].excludes_backlash
        visible: list[JointProperty] = [
            name for name in properties if name != "gear" or is_gear_tight
        ]
        return self._confirm_unknown(visible, PropertyFinding("confirmed", by_shape=True))

    def _confirm_unknown(
        self, properties: Iterable[JointProperty], finding: PropertyFinding
    ) -> "JointVerdict":
        findings = dict(self.findings)
        for name in properties:
            if findings[name].state == "unknown":
                findings[name] = finding
        return replace(self, findings=findings)
