"""Attacks of an unauthorized client on a running robot, and what each of them must not achieve.

The client has a Zenoh session, MessagePack, sockets and the folder `schemas/`. It imports no code of SnakeSIM, which
`test_attack_suite.py` checks. The attacked robot is a `snakesim run` in its own processes. Only `robot_side/` contains
code that runs in these processes.

The identifiers in the test names (`a4`, `c8`) number the attacks. docs/concepts/open-network.md lists what a client can
do, with the test of each row.

    make attack                    every attack, with more repetitions, longer floods and more connections
    pytest verification/attack     every attack once
"""
