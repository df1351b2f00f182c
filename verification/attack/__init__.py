"""A stranger on the robot's network: what he tries, and what must not come of it.

He has `schemas/`, a Zenoh client, MessagePack and sockets, and nothing of ours: `test_stranger.py` holds that no file
here imports a `snakesim_` package. What he is up against is the `snakesim` command in processes of its own; only
`data/` is the robot's side. The numbers in the tests' names are those of docs/concepts/open-network.md.

    make attack                    all of it: more repetitions, longer floods, more connections
    pytest verification/attack     each attack once
"""
