"""The files of a package with a new driver type, by their paths in it."""

import re
from pathlib import Path

DRIVER = Path(__file__).with_name("minimal_driver.py")

PYPROJECT_TEMPLATE = """\
[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"

[project]
name = "snakesim-{dashed}"
version = "0.1.0"
description = "{title} drives for SnakeSIM"
requires-python = ">=3.11"
dependencies = ["snakesim"]

[project.entry-points."snakesim.backends"]
{name} = "{package}.driver:{title}Backend"

[tool.setuptools]
packages = ["{package}"]

[tool.pytest.ini_options]
testpaths = ["tests"]
pythonpath = ["."]
addopts = ["--import-mode=importlib", "-p", "snakesim_testing"]
"""

README_TEMPLATE = """\
# {title} drives for SnakeSIM

`{package}/driver.py` has the protocol, emulated drives and the driver. Replace the protocol by that of your drives.

```sh
python -m pytest                                  # the contract suite of SnakeSIM, on the emulated drives
snakesim run scales --backend ./{package}/driver.py:{title}Backend --duration 3
pip install --editable .                          # then `--backend {name}` is enough
```

Not tested on hardware.
"""

INIT_TEMPLATE = '''"""{title} drives for SnakeSIM."""
'''

CONFTEST_TEMPLATE = '''"""The benches on which the contract suite of SnakeSIM tests this driver type."""

import pytest

from {package}.driver import {title}Backend
from snakesim_testing.contract.bench import Bench
from snakesim_testing.contract.kit_drives import KitDrives, mute_joint

MOUNTINGS = ("joint_2.sign=-1", "joint_3.zero_rad=0.3", "joint_4.gear=1.5")


@pytest.hookimpl(optionalhook=True)
def pytest_snakesim_benches():
    """Return the driver type with emulated drives: mounted as usual, and in other ways that the robot file states."""
    real_mounting = [f"backend.mounted.{{mounting}}" for mounting in MOUNTINGS]
    stated_mounting = [f"robot.joints.{{mounting}}" for mounting in MOUNTINGS]
    return [make_bench("{name}"), make_bench("mounted", *real_mounting, *stated_mounting)]


def make_bench(name, *overrides):
    """Return a bench with this name, and with changed values of its scenario."""
    return Bench(
        name,
        {title}Backend,
        overrides=overrides,
        mute_joint=mute_joint,
        make_emulated_drives=KitDrives,
    )
'''

CONTRACT_TEST_TEMPLATE = '''"""The contract suite of SnakeSIM; see its page docs/hardware/contract-suite.md."""

{imports}'''

SUBJECTS = (
    "closing",
    "description",
    "drives",
    "faults",
    "host",
    "lifecycle",
    "limits",
    "modes",
    "recovery",
    "samples",
    "switching",
)


def make_package_files(name: str) -> dict[str, str]:
    """Return the text of every file of a new driver package, by its path in the folder of the package.

    Args:
        name: Name of the driver type: lower-case words, joined by underscores.
    """
    package = f"{name}_driver"
    title = "".join(word.capitalize() for word in name.split("_"))
    imports = "".join(
        f"from snakesim_testing.contract.test_{subject} import *  # noqa: F403\n"
        for subject in SUBJECTS
    )
    values = {
        "name": name,
        "dashed": name.replace("_", "-"),
        "package": package,
        "title": title,
        "imports": imports,
    }
    return {
        "pyproject.toml": PYPROJECT_TEMPLATE.format(**values),
        "README.md": README_TEMPLATE.format(**values),
        f"{package}/__init__.py": INIT_TEMPLATE.format(**values),
        f"{package}/driver.py": _render_driver_module(name, title, package),
        "tests/conftest.py": CONFTEST_TEMPLATE.format(**values),
        "tests/test_contract.py": CONTRACT_TEST_TEMPLATE.format(**values),
    }


def _render_driver_module(name: str, title: str, package: str) -> str:
    """Return the source text of the minimal driver, renamed to another driver type.

    Args:
        name: Name of the driver type, such as "acme_servo".
        title: Prefix of its classes, such as "AcmeServo".
        package: Name of its Python package, such as "acme_servo_driver".
    """
    text = DRIVER.read_text(encoding="utf-8")
    text = text.replace("./examples/minimal_driver.py", f"./{package}/driver.py")
    text = re.sub(r"\bMinimal(?=[A-Z])", title, text)
    return text.replace('"minimal', f'"{name}')
