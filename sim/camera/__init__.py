"""Simulated Canon EOS that is controlled over PTP, and its raw files."""
