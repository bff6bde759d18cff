"""Rival methods against causal confusion: what each needs beside a row of `methods.METHODS`."""
