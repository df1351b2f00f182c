"""The programs of a run, each of which `snakesim run` starts as a process.

`host_program`      the HAL host: `snakesim start host`
`service_program`   guidance, navigation, control or a custom service: `snakesim start service`
`router_program`    a router for one run
`single_process`    a whole run in one process and one thread: `snakesim run --in-process`
`in_host_service`   a controller in the host's process
`arguments`         command-line arguments that these programs share
`preflight`         checks before the start: whatever the scenario names is installed and accepts its parameters
"""
