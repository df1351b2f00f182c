"""What each extra of the package brings, and what to type when it is missing.

A robot's computer has the core alone; a command that needs more says which `pip install` adds it.
"""

from importlib.util import find_spec

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.plugins import pip_install

BRINGS = {  # as imported; the first extra that brings a package is the one to name for it
    "sim": ("mujoco",),
    "record": ("foxglove_schemas_protobuf", "google", "lz4", "mcap", "zstandard"),
    "report": ("jinja2", "markupsafe"),
    "can": ("bitstruct", "can", "cantools"),
    "commission": ("tomlkit",),
    "dynamixel": ("serial",),
    "console": ("viser", "websockets"),
    "export": ("pyarrow",),
    "evaluate": ("dask", "distributed", "optuna", "pyarrow"),
    "foxglove": ("foxglove",),
    "gym": ("gymnasium",),
    "lab": ("cryptography", "jinja2"),
    "plot": ("matplotlib",),
    "policy": ("onnxruntime",),
    "preview": ("PIL",),
    "ros2": ("rosbags", "xxhash"),
    "train": ("cmaes", "onnx"),
    "video": ("imageio_ffmpeg", "PIL"),
}


def has(extra: str) -> bool:
    """Whether an extra is installed."""
    return not _lacking(extra)


def check(extra: str, who: str, otherwise: str = "") -> None:
    """Raise ConfigError when an extra is missing. who: what needs it; otherwise: how to do without."""
    if lacking := _lacking(extra):
        raise ConfigError(f"{who} needs {', '.join(lacking)}: {pip_install(extra)}{otherwise}")


def explained(error: ModuleNotFoundError) -> ConfigError | None:
    """What to say of an import that failed; None when no extra brings the package."""
    package = (error.name or "").partition(".")[0]
    extra = next((extra for extra, packages in BRINGS.items() if package in packages), None)
    return None if extra is None else ConfigError(f"this command needs {package}: {pip_install(extra)}")


def _lacking(extra: str) -> list[str]:
    return [package for package in BRINGS[extra] if find_spec(package) is None]
