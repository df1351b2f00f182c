"""A process selects the common processor code of NumPy and BLAS, and names results of other code."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest

from snakesim_hal.base import arithmetic

AVX512_CPUINFO = "processor : 0\nflags\t\t: fpu sse2 fma avx2 avx512f\n"


@pytest.fixture
def cpuinfo_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Provide the file in which a test describes another processor, as the kernel would do."""
    monkeypatch.setattr(arithmetic, "CPUINFO", tmp_path / "cpuinfo")
    arithmetic.make_common_arithmetic_env.cache_clear()
    yield tmp_path / "cpuinfo"
    arithmetic.make_common_arithmetic_env.cache_clear()


@pytest.mark.skipif(os.uname().machine != "x86_64", reason="needs a processor of that kind")
def test_arithmetic_of_avx512_processor_is_that_of_a_common_one(cpuinfo_file: Path) -> None:
    cpuinfo_file.write_text(AVX512_CPUINFO)
    environment = arithmetic.make_common_arithmetic_env()
    assert environment["OPENBLAS_CORETYPE"] == "Haswell"
    assert "X86_V4" in environment["NPY_DISABLE_CPU_FEATURES"]


@pytest.mark.skipif(os.uname().machine != "x86_64", reason="needs a processor of that kind")
def test_arithmetic_environment_overrides_earlier_numpy_settings(cpuinfo_file: Path) -> None:
    cpuinfo_file.write_text(AVX512_CPUINFO.replace(" avx512f", ""))
    environment = arithmetic.make_common_arithmetic_env()
    assert environment["NPY_DISABLE_CPU_FEATURES"] == ""
    assert environment["NPY_ENABLE_CPU_FEATURES"] == ""


@pytest.mark.parametrize("flags", ["flags : fpu sse2\n", "Features : fp asimd\n", "", None])
def test_arithmetic_of_unknown_processor_is_not_pinned(
    cpuinfo_file: Path, flags: str | None
) -> None:
    """Code for AVX2 would crash on such a processor."""
    if flags is not None:
        cpuinfo_file.write_text(flags)
    assert arithmetic.make_common_arithmetic_env() == {}
    assert arithmetic.is_pinned()


def measure_arithmetic_of_process(
    *first_statements: str, variables: dict[str, str]
) -> dict[str, str]:
    """Return the arithmetic of a new Python process, by part, as hashes of its results.

    Args:
        *first_statements: Statements that the process executes before it measures. It has imported `arithmetic`.
        variables: Environment variables of the process.
    """
    program = "; ".join(
        [
            "import json",
            "from snakesim_hal.base import arithmetic",
            *first_statements,
            "print(json.dumps(arithmetic.measure_arithmetic()))",
        ]
    )
    environment = {
        name: value
        for name, value in os.environ.items()
        if name not in arithmetic.make_common_arithmetic_env()
    }
    result = subprocess.run(
        [sys.executable, "-c", program],
        env={**environment, **variables},
        capture_output=True,
        check=True,
    )
    return json.loads(result.stdout)


# Variables with which BLAS and NumPy use their code for old processors, without AVX2 and FMA, which rounds otherwise.
OLD_CODE = {"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": "X86_V3"}


@pytest.fixture
def needs_avx2_and_fma() -> None:
    """Skip the test on a processor that has only the old code."""
    if not arithmetic.make_common_arithmetic_env():
        pytest.skip("this processor has no AVX2 and FMA, so that no other code can be selected")


@pytest.mark.usefixtures("needs_avx2_and_fma")
def test_measure_arithmetic_detects_old_code_of_blas_and_numpy() -> None:
    old_arithmetic = measure_arithmetic_of_process(variables=OLD_CODE)
    assert arithmetic.find_differing_parts(old_arithmetic) == ["BLAS", "NumPy"]


@pytest.mark.usefixtures("needs_avx2_and_fma")
def test_pin_arithmetic_before_numpy_import_replaces_old_code() -> None:
    """The process of the test computes in the common arithmetic, too."""
    pinned_arithmetic = measure_arithmetic_of_process(
        "arithmetic.pin_common_arithmetic()", variables=OLD_CODE
    )
    assert pinned_arithmetic == arithmetic.measure_arithmetic()


@pytest.mark.usefixtures("needs_avx2_and_fma")
def test_pin_arithmetic_after_numpy_import_changes_nothing() -> None:
    """NumPy and BLAS select their code when they are imported."""
    old_arithmetic = measure_arithmetic_of_process(variables=OLD_CODE)
    pinned_too_late = measure_arithmetic_of_process(
        "import numpy", "arithmetic.pin_common_arithmetic()", variables=OLD_CODE
    )
    assert pinned_too_late == old_arithmetic


def test_arithmetic_digest_of_other_kernels_is_marked_as_local() -> None:
    other = {**arithmetic.COMMON, "BLAS": "00000000", "C library": "00000000"}
    assert arithmetic.find_differing_parts(other) == ["BLAS", "C library"]
    text = arithmetic.format_digest("0123456789abcdef01", arithmetic.find_differing_parts(other))
    remark = "round otherwise than on most computers with NumPy 2.2 to 2.4"
    assert text == f"0123456789abcdef, its own: BLAS and C library {remark}"
    common_text = arithmetic.format_digest(
        "0123456789abcdef01", arithmetic.find_differing_parts({})
    )
    assert common_text == "0123456789abcdef"


def test_arithmetic_difference_of_newer_wheel_names_the_wheel() -> None:
    numpy_2_5 = {**arithmetic.COMMON, "BLAS": "3f7c15b6"}
    differing_parts = arithmetic.find_differing_parts(numpy_2_5)
    assert differing_parts == ["BLAS of NumPy 2.5"]
    text = arithmetic.format_digest("0123456789abcdef01", differing_parts)
    assert text.startswith(
        "0123456789abcdef, as on most computers with the BLAS of NumPy 2.5, which rounds otherwise"
    )


@pytest.mark.parametrize(
    ("version", "first_name", "last_name"),
    [
        ("2.2.6", "AVX512F", "AVX512_KNM"),
        ("2.3.5", "AVX512F", "AVX512_SPR"),
        ("2.5.1", "X86_V4", "AVX512_SPR"),
    ],
)
def test_arithmetic_disables_only_features_known_to_numpy_version(
    cpuinfo_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    version: str,
    first_name: str,
    last_name: str,
) -> None:
    (tmp_path / "version.py").write_text(f'\nversion = "{version}"\n')
    monkeypatch.setattr(
        "importlib.util.find_spec",
        lambda _: ModuleSpec("numpy", None, origin=f"{tmp_path}/__init__.py"),
    )
    cpuinfo_file.write_text(AVX512_CPUINFO)
    names = arithmetic.make_common_arithmetic_env()["NPY_DISABLE_CPU_FEATURES"].split()
    assert names[0] == first_name
    assert names[-1] == last_name


def test_import_of_snakesim_and_numpy_causes_no_warning() -> None:
    code = "import snakesim; import numpy"
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
