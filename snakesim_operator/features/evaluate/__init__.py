"""Many runs: `snakesim study evaluate`, `sweep` and `optimize`, on workers of this computer or of a Dask cluster.

`arguments`  the three commands' arguments; the only module here that is imported without the extra `train`
`suite`      reads a suite file and makes the cases; `case` is one of them, and runs in a worker
`cluster`    the workers: processes on this computer, or a lab's cluster
`evaluation` runs the cases, keeps what is done (`store`), prints and draws it (`table`, `page`)
`card`       the score card, and how it pairs with others
`optimize`   searches settings with Optuna

Imports `run` and `results`. No other package imports Dask, Optuna or Arrow.
"""
