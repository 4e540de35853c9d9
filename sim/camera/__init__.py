"""The simulated camera: sensor, raw files, and a Canon EOS that speaks PTP."""
