"""Finds the distributions that an installation of SnakeSIM needs, in the metadata of those installed here."""

from importlib.metadata import distribution

from packaging.requirements import Requirement

PROJECT = "snakesim"


def find_required_distributions(extra: str = "") -> set[str]:
    """Return the names of all distributions that SnakeSIM needs, directly or indirectly, without SnakeSIM itself.

    Args:
        extra: An optional extra such as `sim`; empty for a plain installation.
    """
    root = f"{PROJECT}[{extra}]" if extra else PROJECT
    names: set[str] = set()
    visited: set[str] = set()
    pending = [Requirement(root)]
    while pending:
        requirement = pending.pop()
        if str(requirement) in visited:
            continue
        visited.add(str(requirement))
        names.add(requirement.name)
        pending += _find_direct_requirements(requirement)
    return names - {PROJECT}


def _find_direct_requirements(requirement: Requirement) -> list[Requirement]:
    """Return the requirements of a distribution that apply to this computer and to the requested extras."""
    extras = requirement.extras or {""}
    applicable: list[Requirement] = []
    for line in distribution(requirement.name).requires or ():
        candidate = Requirement(line)
        marker = candidate.marker
        if marker is None or any(marker.evaluate({"extra": extra}) for extra in extras):
            candidate.marker = (
                None  # two requirements that differ only in their marker are the same
            )
            applicable.append(candidate)
    return applicable
