"""doojax: simulate, learn and plan the manipulation of deformable one-dimensional objects."""

__version__ = "0.1.0"
