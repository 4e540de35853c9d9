"""Which light an image is under: the table's own, mixtures of them, and how lights are drawn."""
