"""Modules that several parts of the operator package use. Imports the HAL only.

`robot_selection`, `targets`   which robots a command addresses: those of this computer, or of a network
`extras`         the packages that each extra installs
`worker_pool`, `dask_cluster`   processes that compute side by side, here or on a Dask cluster
`console_port`   the sockets of the console, opened before its processes start
`page_origin`    which web pages may connect to a server of ours
`byte_relay`     relays bytes between two connections
`png`            writes PNG images
"""
