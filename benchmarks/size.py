"""How large an installation without extras is: the files of the core dependencies, and theirs."""

import re
from importlib.metadata import PackageNotFoundError, distribution

_NAME = re.compile(r"^[A-Za-z0-9._-]+")


def core_install_mb() -> tuple[float, dict[str, float]]:
    """Total, and by distribution, in megabytes."""
    sizes: dict[str, float] = {}
    pending = ["snakesim"]
    while pending:
        name = re.sub(r"[-_.]+", "-", pending.pop()).lower()
        if name in sizes:
            continue
        try:
            found = distribution(name)
        except PackageNotFoundError:
            continue
        files = [] if name == "snakesim" else found.files or []
        paths = [file.locate() for file in files]
        sizes[name] = sum(path.stat().st_size for path in paths if path.is_file()) / 1e6  # pyright: ignore
        for requirement in found.requires or []:
            if "extra ==" not in requirement:
                match = _NAME.match(requirement)
                if match is not None:
                    pending.append(match[0])
    return sum(sizes.values()), sizes
