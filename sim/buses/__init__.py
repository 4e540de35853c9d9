"""The simulated ends of cables, USB, PTP/IP, serial and memory, and what goes wrong on them."""
