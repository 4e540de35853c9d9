"""Compare two LUTs or sessions of one chart: their differences, and whether noise alone explains them."""
