"""What a session is taken with: real devices, the simulated lab, or a recorded session; opened here only."""
