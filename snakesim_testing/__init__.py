"""The contract suite for authors of backends, and the helpers that the tests of this repository share.

`contract` is the contract suite, a pytest plug-in that loads only on request:

    python -m pytest -p snakesim_testing --pyargs snakesim_testing.contract --snakesim-backend NAME_or_./file.py:Class

`harness`   real processes, sockets and pages
`hal`       small robots, a host on a local network, an authority with a clock, Hypothesis strategies
`drivers`, `can`   drivers and emulated drives on virtual buses, tick by tick
`sim`       small simulated robots          `gnc`   robots on paths, and rendered sensor images
`runs`      the `snakesim` command and whole runs        `operator`   recorded runs, viewers, a browser
`lab`       routers with certificates, machines as network namespaces
`benches`   correct and broken backends on which the contract suite itself is tested
"""

pytest_plugins = ["snakesim_testing.contract.plugin", "snakesim_testing.messages"]
