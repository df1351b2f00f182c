"""How large an installation is: the files of its dependencies."""

from importlib.metadata import distribution

from verification.installation.distributions import required


def install_mb(extra: str = "") -> dict[str, float]:
    """By distribution, in megabytes. extra: empty for a plain install."""
    sizes: dict[str, float] = {}
    for name in required(extra):
        paths = [file.locate() for file in distribution(name).files or ()]
        sizes[name] = sum(path.stat().st_size for path in paths if path.is_file()) / 1e6  # pyright: ignore
    return sizes
