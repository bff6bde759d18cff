"""Benchmarks: speed, with the error against a reference beside it."""
