"""The lens as the print shows it: how much light of their surroundings reaches the cells, and what is left without."""
