"""What a table would be like, as far as frames of a check show it."""
