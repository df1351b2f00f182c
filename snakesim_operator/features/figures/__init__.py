"""`snakesim plot`: figures of a run for a paper, as vector graphics: any signals, and those of the SnakeSIM paper."""
