"""The simulated ends of a camera's cables: USB, USB/IP, PTP/IP, memory."""
