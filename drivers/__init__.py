"""Every foreign wire, bus, display and file that the lab touches; knows none of the rooms above."""
