"""The same loop over other middleware: `make bench-peers`."""
