"""A dataset made piece by piece, by any number of workers, and put together."""
