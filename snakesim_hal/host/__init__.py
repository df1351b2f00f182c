"""The process that owns a robot: one loop, tick by tick.

`host`               the loop           `inbox`, `outbox`   priority queues for input, threads for output
`participants`       services: present, and due in lockstep     `timing`   deadlines, ages of answers
`run_statistics`, `status_messages`    reports
`latch`              the emergency stop that outlives the process; `guarded_backend` turns exceptions into faults
"""
