"""Why a figure is beyond its limit: evidence, a table of rules that decides among causes, and what mends each."""
