"""By which limits a table will be judged, for whoever judges before there is one: the check and the live judge."""
