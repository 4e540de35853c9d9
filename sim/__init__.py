"""The simulated laboratory: the displayed colour decides the photograph."""
