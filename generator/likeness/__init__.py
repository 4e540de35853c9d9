"""How generated data become like a real data set's statistics, or like other generated data under the same lights."""
