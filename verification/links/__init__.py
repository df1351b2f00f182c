"""Measure what a bad network link between a robot and its controller does. Needs root, for network namespaces.

`relay`     forwards frames between two network namespaces, and delays or drops them
`link_lab`  runs the programs of one robot on three machines, each a network namespace
`trials`    measures one row of the two tables in docs/benchmarks/lab-links.md
`__main__`  runs all trials: `python -m verification.links --write` writes docs/benchmarks/lab-links.md
"""
