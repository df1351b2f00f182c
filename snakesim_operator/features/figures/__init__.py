"""`snakesim recording plot`: vector graphics of a run for a paper: signals, and those of the SnakeSIM paper."""
