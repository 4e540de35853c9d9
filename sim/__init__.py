"""The laboratory without hardware: a dark room in which what is shown decides what is seen."""
