"""What several parts of the operator package use. Imports the HAL only.

`robot_selection`, `targets`   which robots a command addresses: those of this computer, or of a network
`extras`         what each extra of the package installs
`worker_pool`, `dask_cluster`   processes that compute side by side, here or on a Dask cluster
`console_port`   the port of the console, opened before the console starts
`page_origin`    which web pages may connect to a server of ours
`png`            writes PNG images
"""
