"""Fuzzing of everything that decodes bytes from the network, and of what a HAL does with what it decoded.

    python -m tests.fuzz --payloads 1000000 [--seed 1]

Every payload is made from a valid one by one seeded mutation. The only exception that may come out of a decoder is
WireError, its message is short whatever the sender wrote, and memory does not grow.
"""
