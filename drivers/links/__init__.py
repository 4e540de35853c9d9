"""The cables: the only files that import socket, pyserial or pyusb."""
