"""Where every cell of the chart lies in a frame, and how far a later frame has moved."""
