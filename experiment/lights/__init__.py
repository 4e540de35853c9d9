"""The illuminations of a session: which codes the projector shows, as a list and as a plot."""
