"""Methods that estimate the illuminant of an image from its statistics, one file per method.

Contract: `method.Method`. `standard_methods` returns all methods by name on the command line.
"""

from evaluation.methods.gray_edge import GrayEdge
from evaluation.methods.method import Image, Learner, LocalMethod, Method
from evaluation.methods.pca import BrightDark
from evaluation.methods.standard import standard_methods

__all__ = ["BrightDark", "GrayEdge", "Image", "Learner", "LocalMethod", "Method", "standard_methods"]
