"""The judged figures: `figure` defines their type, the other modules the figures, `all_figures` their list."""
