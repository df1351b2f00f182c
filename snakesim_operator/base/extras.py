"""Lists the packages of each extra, and prints which command installs a missing extra.

A robot's computer has only the core packages; a command that needs more prints the `pip install` that adds them.
"""

from importlib.util import find_spec

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.plugins import pip_install

BRINGS = {  # import names; messages about a package name the first extra with it
    "sim": ("mujoco",),
    "can": ("bitstruct", "can", "cantools"),
    "serial": ("serial",),
    "record": ("foxglove_schemas_protobuf", "google", "jinja2", "lz4", "markupsafe", "mcap", "zstandard"),
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
    return not _missing_packages(extra)


def require(extra: str, who: str, otherwise: str = "") -> None:
    """Raise ConfigError when an extra is missing.

    Args:
        extra: Its name.
        who: The command or function that needs it.
        otherwise: How to continue without it, added to the message.
    """
    missing = _missing_packages(extra)
    if missing:
        raise ConfigError(
            f"{who} needs {', '.join(missing)}: {pip_install(extra)}{otherwise}", code="extra/not-installed"
        )


def explained(error: ModuleNotFoundError) -> ConfigError | None:
    """Return an error that names the extra with a package that cannot be imported; None when no extra has it."""
    package = (error.name or "").partition(".")[0]
    for extra, packages in BRINGS.items():
        if package in packages:
            return ConfigError(f"this command needs {package}: {pip_install(extra)}", code="extra/not-installed")
    return None


def _missing_packages(extra: str) -> list[str]:
    return [package for package in BRINGS[extra] if find_spec(package) is None]
