"""Carries out faults on request; their words stand in `model.injection`.

`injector`        one per process: what is planned and what is asked for, at its time
`message_faults`  lost, late, doubled and damaged messages; `disturbance` is their arithmetic
`faulty_backend`  any backend, with what goes wrong at its joints; `host_faults` puts both into a host
"""
