"""The paper's experiments, as command lines."""
