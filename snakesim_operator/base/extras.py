"""Lists the packages of each extra, and prints which command installs a missing extra.

A robot's computer has only the core packages; a command that needs more prints the `pip install` that adds them.
"""

from importlib.util import find_spec

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.plugins import make_pip_install_command

PACKAGES_BY_EXTRA = {  # import names; messages about a package mention the first extra that contains it
    "sim": ("mujoco",),
    "can": ("bitstruct", "can", "cantools"),
    "serial": ("serial",),
    "record": (
        "foxglove_schemas_protobuf",
        "google",
        "jinja2",
        "lz4",
        "markupsafe",
        "mcap",
        "zstandard",
    ),
    "console": ("foxglove", "PIL", "viser", "websockets"),
    "report": ("imageio_ffmpeg", "matplotlib", "PIL", "pyarrow"),
    "lab": ("cryptography", "jinja2", "tomlkit"),
    "policy": ("onnxruntime",),
    "ros2": ("rosbags", "xxhash"),
    "gym": ("gymnasium",),
    "train": ("cmaes", "dask", "distributed", "onnx", "optuna"),
}


def is_installed(extra: str) -> bool:
    """Return whether an extra is installed."""
    return not _list_missing_packages(extra)


def require_extra(extra: str, user: str, alternative: str = "") -> None:
    """Raise ConfigError if a package of an extra is not installed.

    Args:
        extra: Name of the extra.
        user: Command or function that needs the extra, for the message.
        alternative: How to continue without the extra, appended to the message.
    """
    missing = _list_missing_packages(extra)
    if missing:
        raise ConfigError(
            f"{user} needs {', '.join(missing)}: {make_pip_install_command(extra)}{alternative}",
            code="extra/not-installed",
        )


def explain_missing_package(error: ModuleNotFoundError) -> ConfigError | None:
    """Make an error that names the extra with a missing package; None if no extra contains the package."""
    package = (error.name or "").partition(".")[0]
    for extra, packages in PACKAGES_BY_EXTRA.items():
        if package in packages:
            return ConfigError(
                f"this command needs {package}: {make_pip_install_command(extra)}",
                code="extra/not-installed",
            )
    return None


def _list_missing_packages(extra: str) -> list[str]:
    """List the packages of an extra that are not installed."""
    return [package for package in PACKAGES_BY_EXTRA[extra] if find_spec(package) is None]
