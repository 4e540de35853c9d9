"""Every foreign wire, bus, display and file that the lab uses; imports none of the packages above it."""
