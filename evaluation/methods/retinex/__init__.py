"""Methods of the Retinex family: local maxima stand for white."""
