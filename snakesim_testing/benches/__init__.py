"""Our benches for the contract suite, and backends that break it."""
