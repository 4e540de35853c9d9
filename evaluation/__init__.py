"""Methods, error metrics and the paper's tables, on generated and on real data."""
