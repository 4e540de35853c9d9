"""Evaluate methods of illumination estimation on generated and real data, and make the tables of the paper."""
