"""`snakesim drive new` writes a driver package with the new name, and refuses bad names and folders."""

import ast
from pathlib import Path

import pytest

from snakesim_drivers.template.new_command import validate_driver_name, write_driver_package
from snakesim_drivers.template.package_files import DRIVER, SUBJECTS, make_package_files
from snakesim_hal.base.errors import ConfigError
from snakesim_testing.contract import plugin
from snakesim_testing.messages import raises_error

EXAMPLE = Path(__file__).parents[4] / "examples" / "minimal_driver.py"


def test_written_driver_has_the_new_name_everywhere() -> None:
    files = make_package_files("acme_servo")
    driver = files["acme_servo_driver/driver.py"]
    classes = {node.name for node in ast.walk(ast.parse(driver)) if isinstance(node, ast.ClassDef)}
    assert {"AcmeServoBackend", "AcmeServoDrives", "AcmeServoEmulator"} <= classes
    assert 'name = "acme_servo"' in driver
    for path, text in files.items():
        assert "minimal" not in text.lower(), path
        assert "{" not in path
    assert 'acme_servo = "acme_servo_driver.driver:AcmeServoBackend"' in files["pyproject.toml"]


def test_written_test_imports_every_subject_of_the_suite() -> None:
    assert sorted(SUBJECTS) == sorted(plugin.SECTION_ORDER)


def test_example_driver_equals_the_template() -> None:
    assert EXAMPLE.read_text() == DRIVER.read_text()


@pytest.mark.parametrize(
    "name", ["", "Acme", "acme-servo", "1st", "a__b", "../acme", "x" * 41, "lambda", "odrive"]
)
def test_invalid_driver_name_is_refused(name: str) -> None:
    with raises_error(ConfigError, code=("config/invalid-value", "config/duplicate-name")):
        validate_driver_name(name)


def test_existing_folder_is_refused_and_kept(tmp_path: Path) -> None:
    existing_file = tmp_path / "acme" / "kept.txt"
    existing_file.parent.mkdir()
    existing_file.write_text("mine")
    with raises_error(ConfigError, code="file/already-exists", field="--out"):
        write_driver_package("acme", existing_file.parent)
    assert [path.name for path in existing_file.parent.iterdir()] == ["kept.txt"]
