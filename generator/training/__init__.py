"""Training crops drawn in memory, with or without PyTorch."""
