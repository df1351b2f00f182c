"""The process that owns a robot: one loop, tick by tick.

`host`               the loop           `inbox`, `outbox`   what comes in by lanes, what goes out by threads
`participants`       who is there, and who owes an answer       `timing`   deadlines, ages of answers
`black_box`, `recorder`, `run_statistics`, `status_messages`    what is kept and told
`latch`              the emergency stop that outlives the process; `guarded_backend` turns its errors into faults
"""
