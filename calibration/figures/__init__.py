"""The judged figures, one object each: `figure` says what one is, `all_figures` lists those of the other files."""
