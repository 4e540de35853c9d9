"""How several lights share an image."""
