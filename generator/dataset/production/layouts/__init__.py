"""How a dataset's images lie: each in its own file, or those of a shard together in one file."""
