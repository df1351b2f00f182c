"""`python -m benchmarks.paths`: the loop over every way through a lab's network, beside raw Zenoh on the same way."""
