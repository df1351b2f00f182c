"""Mutation test of the safety core: change one detail at a time, and check that a unit test fails.

Run it with `python -m verification.mutation [--files limiter.py ...] [--workers 2] [--time-limit 120]`. It prints each
mutant that survives, that is, each change that no test detects. `equivalent.toml` lists the mutants that behave like
the original, with the reason. The exit code is 0 if each mutant is killed or listed there.

A mutant exists only in the memory of a forked process, which imports it instead of the real module. The working tree is
never changed.

Why not mutmut or cosmic-ray: mutmut 3.8 took half the time on lease.py. However, it does not change constants outside
functions, remove statements or swap arguments. It names its mutants by numbers that change with every edit, so an
explanation of a mutant cannot be kept. cosmic-ray 8.7 starts an interpreter for each mutant, which took five times as
long.
"""
