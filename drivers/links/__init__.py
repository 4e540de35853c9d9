"""Cables to devices; only these modules import socket, pyserial and pyusb."""
