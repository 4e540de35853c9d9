"""PTP, the picture transfer protocol of cameras: datasets, sessions and transports."""
