"""Mutation test of the safety core: break one thing at a time, and see that a unit test notices.

    python -m verification.mutation [--files limiter.py ...] [--workers 2] [--time-limit 120]

A mutant lives only in the memory of a forked process, which imports it in place of the real module: nothing is ever
written to the working tree. Mutants that no test can tell from the original stand in `equivalent.toml`, with reasons.

Why not mutmut or cosmic-ray: mutmut 3.8 took half the time on lease.py, but changes no constants outside functions,
removes no statements, swaps no arguments, and names its mutants by numbers that change with every edit: none can
be kept as explained. cosmic-ray 8.7 starts an interpreter for each mutant, which took five times as long.
"""
