"""The arithmetic that a run is computed with: which processor code rounds its sums, powers and sines.

OpenBLAS, NumPy and the C library each choose code for the processor that they find, and the last bits differ from one
choice to the next. One seed gives one digest where all choose alike. That is called the common arithmetic here: the
code for processors with AVX2 and FMA, which nearly every x86-64 computer can run, wider ones too.
`pin_common_arithmetic` selects it, before NumPy is loaded. The result is measured, not guessed: `measure_arithmetic`
hashes the bits of known computations.

NumPy is not imported at the top here, as `pin_common_arithmetic` must come before it.
"""

import hashlib
import importlib.util
import math
import os
import random
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

# What `measure_arithmetic` returns in the common arithmetic, with the wheels of NumPy 2.2 to 2.4. `make golden` prints
# it.
COMMON: Mapping[str, str] = {
    "BLAS": "2a293bd2",
    "NumPy": "072d8a45",
    "C library": "e4139a39",
}
COMMON_WITH = "NumPy 2.2 to 2.4"
# Hashes of the BLAS in other wheels, with the same processor code: such a BLAS rounds alike on all computers.
OTHER_WHEELS: Mapping[str, str] = {"3f7c15b6": "NumPy 2.5"}
SINGLE_THREAD_ENV: dict[str, str] = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)
REQUIRED_PROCESSOR_FLAGS = {"avx2", "fma"}  # of the processor
# The code in NumPy for wider processors, by the version that began to call it so. NumPy warns of names that it does not
# know, and where warnings are errors it cannot be imported then.
WIDER_BEFORE_2_3 = (
    "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_KNL AVX512_KNM"
)
WIDER: Mapping[tuple[int, int], str] = {
    (2, 4): "X86_V4 AVX512_ICL AVX512_SPR",
    (2, 3): f"{WIDER_BEFORE_2_3} AVX512_SPR",
    (0, 0): WIDER_BEFORE_2_3,
}
CPUINFO = Path("/proc/cpuinfo")
MAX_MATRIX_SIZE = 30  # rows and columns of the largest matrix that `measure_arithmetic` uses


@cache
def make_common_arithmetic_env() -> dict[str, str]:
    """Return variables that make a process compute in the common arithmetic; none for a processor that cannot."""
    if os.uname().machine != "x86_64":
        return {}
    flags = _read_processor_flags()
    if not flags >= REQUIRED_PROCESSOR_FLAGS:
        return {}
    wider = ""
    if "avx512f" in flags:
        wider = _find_wider_code_names(_find_numpy_version())
    return {
        "OPENBLAS_CORETYPE": "Haswell",
        "NPY_DISABLE_CPU_FEATURES": wider,
        # NumPy refuses to start if both variables have a value. An empty one counts as unset.
        "NPY_ENABLE_CPU_FEATURES": "",
    }


def pin_common_arithmetic(*, one_thread: bool = False) -> None:
    """Compute in the common arithmetic, here and in child processes. It has no effect after NumPy was imported.

    Args:
        one_thread: Whether linear algebra runs in one thread. For matrices of a robot's size, more threads are slower.
    """
    if "numpy" in sys.modules:
        return
    os.environ.update(make_common_arithmetic_env())
    if one_thread:
        os.environ.update(SINGLE_THREAD_ENV)


def is_pinned() -> bool:
    """Return whether this process computes in the common arithmetic.

    True also where nothing could make it do so: then a child process would not either.
    """
    if make_common_arithmetic_env().items() <= os.environ.items():
        return True
    differing = find_differing_parts(measure_arithmetic())
    return "BLAS" not in differing and "NumPy" not in differing


def find_differing_parts(parts: Mapping[str, str]) -> list[str]:
    """Name the parts of a measured arithmetic that differ from the common one, such as "BLAS", "BLAS of NumPy 2.5"."""
    differing: list[str] = []
    for part, digest in COMMON.items():
        measured_digest = parts.get(part, digest)
        if measured_digest in OTHER_WHEELS:
            differing.append(f"{part} of {OTHER_WHEELS[measured_digest]}")
        elif measured_digest != digest:
            differing.append(part)
    return differing


def format_digest(digest: str, differing: Sequence[str]) -> str:
    """Return a run's digest for people.

    Args:
        digest: The whole digest.
        differing: What `find_differing_parts` returns of the arithmetic in which it was computed.
    """
    beginning = digest[:16]
    unusual = [part for part in differing if part in COMMON]
    if unusual:
        verb = "rounds" if len(unusual) == 1 else "round"
        parts = " and ".join(unusual)
        return f"{beginning}, its own: {parts} {verb} otherwise than on most computers with {COMMON_WITH}"
    if differing:
        return f"{beginning}, as on most computers with the {differing[0]}, which rounds otherwise than {COMMON_WITH}"
    return beginning


@cache
def measure_arithmetic() -> dict[str, str]:
    """Return the arithmetic of this process: for each part a hash of its results. Takes about 10 ms, once."""
    from threadpoolctl import threadpool_limits

    generator = random.Random(22)
    numbers = [generator.uniform(-3.0, 3.0) for _ in range(2000)]  # the same on every computer
    with threadpool_limits(1):
        return {
            "BLAS": _compute_digest(_compute_linear_algebra(numbers)),
            "NumPy": _compute_digest(_compute_elementwise(numbers)),
            "C library": _compute_digest(_compute_library_functions(numbers)),
        }


def _compute_linear_algebra(numbers: list[float]) -> Iterable[Any]:
    """Yield results of BLAS and LAPACK, whose hash shows which processor code rounds the sums of linear algebra.

    The matrices have the sizes of a robot's. Their numbers mean nothing.

    Args:
        numbers: Pseudo-random numbers, at least MAX_MATRIX_SIZE squared.

    Yields:
        Arrays and numbers. Their order is part of the hash.
    """
    import numpy as np

    for size in (2, 3, 4, 8, 13, MAX_MATRIX_SIZE):
        a = np.array(numbers[: size * size]).reshape(size, size)
        b = np.array(numbers[-size * 3 :]).reshape(size, 3)
        tall = np.vstack([a, b.T])  # more rows than columns, for least squares
        right_side = tall[:, 0] ** 2
        square = a @ a.T + size * np.eye(size)  # positive definite, for Cholesky
        # Products.
        yield from (
            a @ b,
            a.T @ b,
            b.T @ a,
            a @ b[:, 0],
            b[:, 0] @ a,
            b[:, 0] @ b[:, 1],
            np.linalg.norm(b),
        )
        # Factorizations, and the product that was factorized.
        yield from (
            np.linalg.solve(square, b),
            np.linalg.inv(square),
            np.linalg.cholesky(square),
            square,
        )
        yield from (
            np.linalg.eigvalsh(square),
            np.linalg.lstsq(tall, right_side, rcond=None)[0],
        )
        yield from (np.linalg.pinv(tall), np.linalg.cond(a))


def _compute_elementwise(numbers: list[float]) -> Iterable[Any]:
    """Yield results of NumPy's element-wise functions, reductions and complex arithmetic.

    NumPy has several implementations of each, for different processors, which may round differently.

    Stable sorting is left out: NumPy has only one loop for it.
    """
    import numpy as np

    x = np.array(numbers)
    y = np.array(numbers[::-1])
    # Element-wise functions.
    yield from (
        np.exp(x),
        np.arctan2(x, y),
        np.tanh(x),
        np.log(np.abs(x)),
        np.abs(x) ** y,
        np.arctan(x),
        np.expm1(x),
        np.sinh(x),
    )
    yield from (
        np.sin(x),
        np.cos(x),
        np.hypot(x, y),
        np.sqrt(np.abs(x)),
        np.arccos(x / 3.0),
        np.tan(x),
    )
    # Reductions.
    yield from (
        x.sum(),
        x[:13].sum(),
        x.reshape(-1, 4).sum(axis=0),
        x.mean(),
        x.std(),
        np.cumsum(x),
        np.einsum("i,i", x, y),
    )
    # Complex and single-precision numbers.
    yield from (
        np.abs(x + 1j * y),
        (x + 1j * y) * (y - 1j * x),
        np.angle(x + 1j * y),
        np.exp(1j * x),
    )
    yield from (np.sin(x.astype(np.float32)), np.exp(x.astype(np.float32)))


def _compute_library_functions(numbers: list[float]) -> Iterable[Any]:
    """Yield results of functions of the C library, as MuJoCo and Python call them, and of Python's own `hypot`."""
    backwards = numbers[::-1]
    for function in (math.sin, math.cos, math.tan, math.exp, math.atan, math.tanh):
        yield [function(x) for x in numbers]
    yield [math.log(abs(x)) for x in numbers]
    yield [math.acos(x / 3.0) for x in numbers] + [math.asin(x / 3.0) for x in numbers]
    yield [math.atan2(x, y) for x, y in zip(numbers, backwards, strict=True)]
    yield [math.pow(abs(x), y) for x, y in zip(numbers, backwards, strict=True)]
    yield [math.hypot(*numbers[i : i + 3]) for i in range(len(numbers) - 3)]


def _compute_digest(results: Iterable[Any]) -> str:
    import numpy as np

    digest = hashlib.sha256()
    for result in results:
        digest.update(np.ascontiguousarray(result).tobytes())
    return digest.hexdigest()[:8]


def _find_wider_code_names(numpy_version: tuple[int, int]) -> str:
    """Return NumPy's names of its code for wider processors, as this version knows them."""
    return next(names for since, names in WIDER.items() if numpy_version >= since)


def _find_numpy_version() -> tuple[int, int]:
    """Return major and minor number of the installed NumPy without importing it; the newest ones if unknown."""
    newest = next(iter(WIDER))
    spec = importlib.util.find_spec("numpy")
    if spec is None or spec.origin is None:
        return newest
    try:
        text = Path(spec.origin).with_name("version.py").read_text(errors="replace")
    except OSError:
        return newest
    number = re.search(r'^version = "(\d+)\.(\d+)', text, re.MULTILINE)
    return newest if number is None else (int(number[1]), int(number[2]))


def _read_processor_flags() -> set[str]:
    """Return the abilities of the processor, by the kernel's names; empty where they are not known."""
    try:
        lines = CPUINFO.read_text(errors="replace").splitlines()
    except OSError:
        return set()
    flags: set[str] = set()
    for line in lines:
        if line.startswith("flags"):
            flags.update(line.partition(":")[2].split())
    return flags
