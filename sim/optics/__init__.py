"""The lens of the simulated room: what it does to the light beside a Gaussian blur."""
