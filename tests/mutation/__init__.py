"""Mutation test of the safety core: break one thing at a time, and see that a unit test notices.

    python -m tests.mutation [--files gate.py ...] [--workers 2] [--time-limit 120]

A mutant lives only in the memory of a forked process, which imports it in place of the real module: nothing is ever
written to the working tree. Mutants that no test can tell from the original stand in `equivalent.toml`, with reasons.
"""
