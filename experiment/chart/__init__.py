"""The printed chart: what is on it, where, and the files a print shop is given."""
