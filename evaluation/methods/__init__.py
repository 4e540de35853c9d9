"""Methods that estimate the light of an image from its statistics, one file a method.

Every method is a value with a name and `estimate(image, saturation, mask)`, see `method.Method`; `standard_methods`
lists them by their names on the command line.
"""

from evaluation.methods.gray_edge import GrayEdge
from evaluation.methods.method import Image, Learner, LocalMethod, Method
from evaluation.methods.pca import BrightDark
from evaluation.methods.standard import standard_methods

__all__ = ["BrightDark", "GrayEdge", "Image", "Learner", "LocalMethod", "Method", "standard_methods"]
