"""How far two sessions of one chart differ, and how far noise alone would let them."""
