"""Deconfounded imitation learning: find the nuisance a cloned policy would copy, and mask it."""

__version__ = "0.1.0"
