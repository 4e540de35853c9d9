"""Open the devices of a rig, that is of a real or a simulated laboratory."""
