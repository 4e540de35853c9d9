"""What every package stands on: errors, time, the terminal, whole files, and numerics that belong to no floor."""
