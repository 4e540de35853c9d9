"""Device protocols, buses, displays and raw files; imports only `foundation`."""
