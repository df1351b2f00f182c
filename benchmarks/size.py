"""The size of an installation: the files of SnakeSIM's dependencies."""

from importlib.metadata import distribution

from verification.installation.distributions import find_required_distributions

BYTES_A_MB = 1e6


def measure_install_mb(extra: str = "") -> dict[str, float]:
    """Return the size in megabytes of each distribution that SnakeSIM needs.

    Args:
        extra: an optional extra such as `sim`; empty for a plain installation.
    """
    sizes_mb: dict[str, float] = {}
    for name in find_required_distributions(extra):
        paths = [file.locate() for file in distribution(name).files or ()]
        size_bytes = sum(path.stat().st_size for path in paths if path.is_file())  # pyright: ignore
        sizes_mb[name] = size_bytes / BYTES_A_MB
    return sizes_mb
