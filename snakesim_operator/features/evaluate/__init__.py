"""Many runs: `snakesim study evaluate`, `sweep` and `optimize`, on workers of this computer or of a Dask cluster.

A suite has conditions. A trial is one run: one condition, one controller and one seed, which gives the random scene.

`arguments`         the arguments of the three commands; the only module here that is imported without the extra `train`
`suite`             reads a suite file
`conditions`        what each condition of a suite sets in the scenario
`trial_list`        makes the trials of a suite, each with its whole configuration
`trial`             one trial, which runs in a worker
`workers`           the workers: processes on this computer, or a Dask cluster
`evaluation`        runs the trials, stores their outcomes (`store`), prints and draws them (`table`, `page`)
`condition_results` the outcomes of one condition with one controller
`score_card`        the score card, and the comparison of controllers
`optimize`          searches values of keys with Optuna; `search_file` keeps what it has found

Imports `run` and `results`. No other package imports Dask, Optuna or Arrow.
"""
