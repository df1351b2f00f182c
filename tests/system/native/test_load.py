"""Native libraries are compiled and loaded on first use; without one, Python is used and a problem is reported."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from snakesim_native import compile as native_compile
from snakesim_native import libraries, load
from snakesim_native.libraries import NativeLibrary

SOURCE_TEMPLATE = "int three(void);\nint three(void) { return %d; }\n"
NUMBERS = NativeLibrary(name="numbers", uses_mujoco=False, python_cost="counting takes longer")


@pytest.fixture(autouse=True)
def small_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Make a package of one library, and a user's cache."""
    package = tmp_path / "package"
    (package / "numbers").mkdir(parents=True)
    (package / "numbers" / "three.c").write_text(SOURCE_TEMPLATE % 3)
    monkeypatch.setattr(libraries, "PACKAGE", package)
    for module in (native_compile, load):
        monkeypatch.setattr(module, "SHIPPED_FOLDER", package / "compiled")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("SNAKESIM_NATIVE", raising=False)
    load._load_cached.cache_clear()
    yield package
    load._load_cached.cache_clear()


def reload_library() -> load.LoadedLibrary:
    """Load the library without the cache of this process."""
    load._load_cached.cache_clear()
    return load.load_shared_library(NUMBERS)


@pytest.fixture
def compiler() -> None:
    """Skip a test on a computer that has no C compiler."""
    if not native_compile.list_compilers():
        pytest.skip("this computer has no C compiler")


@pytest.mark.usefixtures("compiler")
def test_library_loaded_first_time_is_compiled(small_package: Path) -> None:
    loaded = reload_library()
    assert loaded.library is not None, loaded.problem
    assert loaded.library.three() == 3
    assert loaded.path is not None
    assert loaded.path.parent == small_package / "compiled"


@pytest.mark.usefixtures("compiler")
def test_library_with_changed_source_replaces_its_older_build(
    small_package: Path,
) -> None:
    old = reload_library()
    (small_package / "numbers" / "three.c").write_text(SOURCE_TEMPLATE % 4)
    new = reload_library()
    assert new.library is not None
    assert new.library.three() == 4
    assert new.path != old.path
    assert list((small_package / "compiled").iterdir()) == [new.path]


@pytest.mark.usefixtures("compiler")
def test_library_file_compiled_from_other_sources_is_not_used(small_package: Path) -> None:
    old = reload_library().path
    assert old is not None
    (small_package / "numbers" / "three.c").write_text(SOURCE_TEMPLATE % 4)
    key = libraries.compute_build_key(NUMBERS, "")
    old.rename(old.with_name(libraries.make_file_name(NUMBERS, key)))
    loaded = reload_library()
    assert loaded.library is None
    assert "was compiled from other sources" in loaded.problem


@pytest.mark.usefixtures("compiler")
def test_library_in_read_only_package_uses_user_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(load, "_is_writable", lambda _folder: False)
    loaded = reload_library()
    assert loaded.library is not None, loaded.problem
    assert loaded.path is not None
    assert loaded.path.is_relative_to(tmp_path / "cache")


@pytest.mark.heavy
@pytest.mark.usefixtures("compiler")
def test_library_compiled_by_two_processes_at_once_succeeds(tmp_path: Path) -> None:
    program = (
        "from snakesim_native.compile import compile_library; from snakesim_native.libraries import LAWS_LIBRARY; "
        "from pathlib import Path; import sys; compile_library(LAWS_LIBRARY, Path(sys.argv[1]))"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "both")]
    processes = [subprocess.Popen(command) for _ in range(2)]
    assert [process.wait(60) for process in processes] == [0, 0]
    assert len(list((tmp_path / "both").iterdir())) == 1


def test_library_without_compiler_reports_problem(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native_compile, "list_compilers", lambda _target=None: [])
    loaded = reload_library()
    assert loaded.library is None
    assert loaded.problem == native_compile.NO_COMPILER


def test_library_with_invalid_source_reports_problem(small_package: Path) -> None:
    (small_package / "numbers" / "three.c").write_text("int three(")
    assert reload_library().problem


def test_library_disabled_by_environment_variable_reports_problem(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("SNAKESIM_NATIVE", "off")
    assert reload_library().problem == "the environment variable SNAKESIM_NATIVE is `off`"


def test_installation_without_compiler_succeeds_and_prints_the_cost(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(native_compile, "LIBRARIES", (NUMBERS,))
    monkeypatch.setattr(native_compile, "list_compilers", lambda _target=None: [])
    assert native_compile.main() == 0
    assert capsys.readouterr().out.count("\n") == 1
