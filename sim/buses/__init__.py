"""Simulated device ends of the connections: USB, PTP/IP and serial port."""
