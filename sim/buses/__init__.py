"""Simulated ends of cables: USB, PTP/IP, serial port and memory."""
