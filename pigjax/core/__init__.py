"""Arrays, errors, checks, 3x3 linear algebra, cameras and metrics: the basis of every other package."""

__version__ = "0.1.0"
