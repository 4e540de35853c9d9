"""Connections to devices: USB, serial and network; only these modules import socket, pyserial and pyusb."""
