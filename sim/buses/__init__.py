"""The simulated ends of cables, USB, USB/IP, PTP/IP, serial and memory, and what goes wrong on them."""
