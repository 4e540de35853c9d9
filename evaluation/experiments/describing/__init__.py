"""What images and lights a data set is made of, beside another's: how real is what was generated."""
