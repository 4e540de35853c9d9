"""PTP, the picture transfer protocol of cameras: its wires, its transports and the cameras that speak it."""
