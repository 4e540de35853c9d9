"""Open the devices of a rig: real ones, or the simulated laboratory."""
