"""Carries out injected faults; their vocabulary is in `snakesim_hal.model.fault_kinds`.

`injector`        one per process: planned and requested faults, at their times
`message_faults`  lost, late, duplicated and corrupted messages; `disturbance` is the pure part
`faulty_backend`  wraps any backend, with faults of its joints; `host_faults` puts both into a host
"""
