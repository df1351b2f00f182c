"""Which distributions an installation has, by the metadata of those that are installed here."""

from importlib.metadata import distribution

from packaging.requirements import Requirement


def required(extra: str = "") -> set[str]:
    """Names of all that SnakeSIM, and an extra of it, needs; without its own."""
    found, seen = set[str](), set[str]()
    left = [Requirement(f"snakesim[{extra}]" if extra else "snakesim")]
    while left:
        asked = left.pop()
        if str(asked) in seen:
            continue
        seen.add(str(asked))
        found.add(asked.name)
        for line in distribution(asked.name).requires or ():
            needed = Requirement(line)
            if needed.marker is None or any(
                needed.marker.evaluate({"extra": one}) for one in asked.extras or {""}
            ):
                needed.marker = None
                left.append(needed)
    return found - {"snakesim"}
