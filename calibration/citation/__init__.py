"""What makes a table citable: with what, when and by whom it was taken, and under which licence it may be used."""
