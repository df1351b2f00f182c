"""The arithmetic that a run is computed with: which processor code rounds its sums, powers and sines.

OpenBLAS, NumPy and the C library each choose code for the processor that they find, and the last bits differ from one
choice to the next. One seed gives one digest where all choose alike. That is called the common arithmetic here: the
code for processors with AVX2 and FMA, which nearly every x86-64 computer can run, wider ones too. `pin` asks for it,
before NumPy is loaded. What came of it is measured, not guessed: `measured` hashes the bits of known computations.

NumPy is not imported at the top here, as `pin` must come before it.
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

COMMON: Mapping[str, str] = {
    "BLAS": "2a293bd2",
    "NumPy": "072d8a45",
    "C library": "e4139a39",
}
"""What `measured` finds in the common arithmetic, with the wheels of NumPy 2.2 to 2.4; `make golden` prints it."""
COMMON_WITH = "NumPy 2.2 to 2.4"
OTHER_WHEELS: Mapping[str, str] = {"3f7c15b6": "NumPy 2.5"}
"""Hashes of the BLAS in other wheels, with the same processor code: such a BLAS rounds alike on all computers."""
ONE_THREAD: dict[str, str] = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
NEEDED = {"avx2", "fma"}  # flags of the processor
# The code in NumPy for wider processors, by the version that began to call it so. NumPy warns of names that it does not
# know, and where warnings are errors it cannot be imported then.
WIDER_BEFORE_2_3 = "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL AVX512_KNL AVX512_KNM"
WIDER: Mapping[tuple[int, int], str] = {
    (2, 4): "X86_V4 AVX512_ICL AVX512_SPR",
    (2, 3): f"{WIDER_BEFORE_2_3} AVX512_SPR",
    (0, 0): WIDER_BEFORE_2_3,
}
CPUINFO = Path("/proc/cpuinfo")


@cache
def environment() -> dict[str, str]:
    """Variables that make a process compute in the common arithmetic; none for a processor that cannot."""
    if os.uname().machine != "x86_64" or not (flags := _processor_flags()) >= NEEDED:
        return {}
    wider = _names_of_wider_code(_numpy_version()) if "avx512f" in flags else ""
    # Empty is as good as unset; NumPy refuses to be told what to enable and what to disable.
    return {"OPENBLAS_CORETYPE": "Haswell", "NPY_DISABLE_CPU_FEATURES": wider, "NPY_ENABLE_CPU_FEATURES": ""}


def pin(*, one_thread: bool = False) -> None:
    """Compute in the common arithmetic, here and in child processes. Too late, and without effect, after NumPy.

    one_thread: nor have linear algebra start threads, which matrices of a robot's size only wait for.
    """
    if "numpy" not in sys.modules:
        os.environ.update(environment() | ONE_THREAD if one_thread else environment())


def is_pinned() -> bool:
    """Whether this process computes in the common arithmetic, or nothing could make it: a child would be no better."""
    wanted = environment().items()
    return wanted <= os.environ.items() or not {"BLAS", "NumPy"} & {*foreign(measured())}


def foreign(parts: Mapping[str, str]) -> list[str]:
    """Name the parts of a measured arithmetic that differ from the common one, such as "BLAS", "BLAS of NumPy 2.5"."""
    differing: list[str] = []
    for part, digest in COMMON.items():
        found = parts.get(part, digest)
        if found in OTHER_WHEELS:
            differing.append(f"{part} of {OTHER_WHEELS[found]}")
        elif found != digest:
            differing.append(part)
    return differing


def digest_text(digest: str, differing: Sequence[str]) -> str:
    """Return a run's digest for people.

    Args:
        digest: The whole digest.
        differing: What `foreign` returns of the arithmetic in which it was computed.
    """
    own = [part for part in differing if part in COMMON]
    if own:
        verb = "rounds" if len(own) == 1 else "round"
        return f"{digest[:16]}, its own: {' and '.join(own)} {verb} otherwise than on most computers with {COMMON_WITH}"
    if differing:
        return f"{digest[:16]}, as on most computers with the {differing[0]}, which rounds otherwise than {COMMON_WITH}"
    return digest[:16]


@cache
def measured() -> dict[str, str]:
    """The arithmetic of this process: for each part a hash of the bits that it gives. Takes about 10 ms, once."""
    from threadpoolctl import threadpool_limits

    drawn = random.Random(22)
    numbers = [drawn.uniform(-3.0, 3.0) for _ in range(2000)]
    with threadpool_limits(1):
        return {
            "BLAS": _digest(_linear(numbers)),
            "NumPy": _digest(_elementwise(numbers)),
            "C library": _digest(_functions(numbers)),
        }


def _linear(numbers: list[float]) -> Iterable[Any]:
    """What goes through BLAS and LAPACK, in the sizes of a robot."""
    import numpy as np

    for size in (2, 3, 4, 8, 13, 30):
        a = np.array(numbers[: size * size]).reshape(size, size)
        b = np.array(numbers[-size * 3 :]).reshape(size, 3)
        tall, square = np.vstack([a, b.T]), a @ a.T + size * np.eye(size)
        yield from (a @ b, a.T @ b, b.T @ a, a @ b[:, 0], b[:, 0] @ a, b[:, 0] @ b[:, 1], np.linalg.norm(b))
        yield from (np.linalg.solve(square, b), np.linalg.inv(square), np.linalg.cholesky(square), square)
        yield from (np.linalg.eigvalsh(square), np.linalg.lstsq(tall, tall[:, 0] ** 2, rcond=None)[0])
        yield from (np.linalg.pinv(tall), np.linalg.cond(a))


def _elementwise(numbers: list[float]) -> Iterable[Any]:
    """NumPy's own loops, of which it has several for each processor (but one for a stable sort, as ours is)."""
    import numpy as np

    x, y = np.array(numbers), np.array(numbers[::-1])
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
    yield from (np.sin(x), np.cos(x), np.hypot(x, y), np.sqrt(np.abs(x)), np.arccos(x / 3.0), np.tan(x))
    yield from (
        x.sum(),
        x[:13].sum(),
        x.reshape(-1, 4).sum(axis=0),
        x.mean(),
        x.std(),
        np.cumsum(x),
        np.einsum("i,i", x, y),
    )
    yield from (np.abs(x + 1j * y), (x + 1j * y) * (y - 1j * x), np.angle(x + 1j * y), np.exp(1j * x))
    yield from (np.sin(x.astype(np.float32)), np.exp(x.astype(np.float32)))


def _functions(numbers: list[float]) -> Iterable[Any]:
    """Functions of the C library, as MuJoCo and Python call them; Python has a `hypot` of its own."""
    for function in (math.sin, math.cos, math.tan, math.exp, math.atan, math.tanh):
        yield [function(x) for x in numbers]
    yield [math.log(abs(x)) for x in numbers]
    yield [math.acos(x / 3.0) for x in numbers] + [math.asin(x / 3.0) for x in numbers]
    yield [math.atan2(x, y) for x, y in zip(numbers, numbers[::-1], strict=True)]
    yield [math.pow(abs(x), y) for x, y in zip(numbers, numbers[::-1], strict=True)]
    yield [math.hypot(*numbers[i : i + 3]) for i in range(len(numbers) - 3)]


def _digest(results: Iterable[Any]) -> str:
    import numpy as np

    digest = hashlib.sha256()
    for result in results:
        digest.update(np.ascontiguousarray(result).tobytes())
    return digest.hexdigest()[:8]


def _names_of_wider_code(numpy_version: tuple[int, int]) -> str:
    return next(names for since, names in WIDER.items() if numpy_version >= since)


def _numpy_version() -> tuple[int, int]:
    """Return major and minor number of the installed NumPy without importing it; the newest ones if unknown."""
    newest = next(iter(WIDER))
    found = importlib.util.find_spec("numpy")
    if found is None or found.origin is None:
        return newest
    try:
        text = Path(found.origin).with_name("version.py").read_text(errors="replace")
    except OSError:
        return newest
    number = re.search(r'^version = "(\d+)\.(\d+)', text, re.MULTILINE)
    return newest if number is None else (int(number[1]), int(number[2]))


def _processor_flags() -> set[str]:
    """What the processor can do, as the kernel calls it; empty where that is not known."""
    try:
        lines = CPUINFO.read_text(errors="replace").splitlines()
    except OSError:
        return set()
    return {flag for line in lines if line.startswith("flags") for flag in line.partition(":")[2].split()}
