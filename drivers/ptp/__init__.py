"""PTP, the Picture Transfer Protocol of cameras (ISO 15740): data formats, sessions, USB and network."""
