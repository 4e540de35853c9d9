"""What `foundation.compiled` is made of: numba makes machine code, LLVM alone loads it the next time."""
