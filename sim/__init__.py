"""The laboratory without hardware: a room in which what is shown decides what is photographed."""
