"""The version, which a run directory is of."""

__version__ = "0.7.0"
