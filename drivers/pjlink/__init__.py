"""PJLink, the projector industry's control protocol over TCP (JBMIA PJLink 1.04, 2.00)."""
