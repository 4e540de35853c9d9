"""The simulated projectors and screens, each speaking its own protocol."""
