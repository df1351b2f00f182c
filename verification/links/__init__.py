"""A lab of network namespaces: links that are cut, lose and delay packets, and routers that die.

`relay`     a link that loses and delays, packet by packet
`lab`       the programs of a robot on three machines
`__main__`  `python -m verification.links --write` writes docs/benchmarks/lab-links.md
"""
