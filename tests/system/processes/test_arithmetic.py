"""Which processor code a process computes with, and what is said where it is another."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest

from snakesim_hal.base import arithmetic

INTEL = "processor : 0\nflags\t\t: fpu sse2 fma avx2 avx512f\n"


@pytest.fixture
def computer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """What the kernel says of another processor."""
    monkeypatch.setattr(arithmetic, "CPUINFO", tmp_path / "cpuinfo")
    arithmetic.make_common_arithmetic_env.cache_clear()
    yield tmp_path / "cpuinfo"
    arithmetic.make_common_arithmetic_env.cache_clear()


@pytest.mark.skipif(os.uname().machine != "x86_64", reason="about processors of that driver_type")
def test_a_wide_processor_computes_as_a_usual_one(computer: Path) -> None:
    computer.write_text(INTEL)
    wanted = arithmetic.make_common_arithmetic_env()
    assert wanted["OPENBLAS_CORETYPE"] == "Haswell"
    assert "X86_V4" in wanted["NPY_DISABLE_CPU_FEATURES"]


@pytest.mark.skipif(os.uname().machine != "x86_64", reason="about processors of that driver_type")
def test_what_was_set_before_has_no_effect(computer: Path) -> None:
    computer.write_text(INTEL.replace(" avx512f", ""))
    wanted = arithmetic.make_common_arithmetic_env()
    assert wanted["NPY_DISABLE_CPU_FEATURES"] == wanted["NPY_ENABLE_CPU_FEATURES"] == ""


@pytest.mark.parametrize("flags", ["flags : fpu sse2\n", "Features : fp asimd\n", "", None])
def test_arithmetic_of_unknown_processor_is_not_pinned(computer: Path, flags: str | None) -> None:
    """Code for AVX2 would crash there."""
    if flags is not None:
        computer.write_text(flags)
    assert arithmetic.make_common_arithmetic_env() == {}
    assert arithmetic.is_pinned()


def measured_with(code: str, **more: str) -> dict[str, str]:
    show = (
        "import json; from snakesim_hal.base import arithmetic; {}; "
        "print(json.dumps(arithmetic.measure_arithmetic()))"
    )
    unset = {
        name: value
        for name, value in os.environ.items()
        if name not in arithmetic.make_common_arithmetic_env()
    }
    done = subprocess.run(
        [sys.executable, "-c", show.format(code)],
        env={**unset, **more},
        capture_output=True,
        check=True,
    )
    return json.loads(done.stdout)


def test_what_a_process_computes_with_is_measured() -> None:
    if not arithmetic.make_common_arithmetic_env():
        pytest.skip("this processor has no AVX2 and FMA, so nothing can be chosen")
    old = {"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": "X86_V3"}
    assert arithmetic.find_differing_parts(measured_with("pass", **old)) == ["BLAS", "NumPy"]
    assert (
        measured_with("arithmetic.pin_common_arithmetic()", **old)
        == arithmetic.measure_arithmetic()
    )
    assert measured_with(
        "import numpy; arithmetic.pin_common_arithmetic()", **old
    ) == measured_with("pass", **old)


def test_arithmetic_digest_of_other_kernels_is_marked_as_local() -> None:
    other = {**arithmetic.COMMON, "BLAS": "00000000", "C library": "00000000"}
    assert arithmetic.find_differing_parts(other) == ["BLAS", "C library"]
    said = arithmetic.format_digest("0123456789abcdef01", arithmetic.find_differing_parts(other))
    otherwise = "round otherwise than on most computers with NumPy 2.2 to 2.4"
    assert said == f"0123456789abcdef, its own: BLAS and C library {otherwise}"
    assert (
        arithmetic.format_digest("0123456789abcdef01", arithmetic.find_differing_parts({}))
        == "0123456789abcdef"
    )


def test_arithmetic_difference_of_newer_wheel_names_the_wheel() -> None:
    of_2_5 = {**arithmetic.COMMON, "BLAS": "3f7c15b6"}
    assert arithmetic.find_differing_parts(of_2_5) == ["BLAS of NumPy 2.5"]
    said = arithmetic.format_digest("0123456789abcdef01", arithmetic.find_differing_parts(of_2_5))
    assert said.startswith(
        "0123456789abcdef, as on most computers with the BLAS of NumPy 2.5, which rounds otherwise"
    )


@pytest.mark.parametrize(
    ("version", "first", "last"),
    [
        ("2.2.6", "AVX512F", "AVX512_KNM"),
        ("2.3.5", "AVX512F", "AVX512_SPR"),
        ("2.5.1", "X86_V4", "AVX512_SPR"),
    ],
)
def test_numpy_is_given_only_names_that_its_version_knows(
    computer: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    version: str,
    first: str,
    last: str,
) -> None:
    (tmp_path / "version.py").write_text(f'\nversion = "{version}"\n')
    monkeypatch.setattr(
        "importlib.util.find_spec",
        lambda _: ModuleSpec("numpy", None, origin=f"{tmp_path}/__init__.py"),
    )
    computer.write_text(INTEL)
    names = arithmetic.make_common_arithmetic_env()["NPY_DISABLE_CPU_FEATURES"].split()
    assert names[0] == first
    assert names[-1] == last


def test_numpy_can_be_imported_where_warnings_are_errors() -> None:
    code = "import snakesim; import numpy"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
