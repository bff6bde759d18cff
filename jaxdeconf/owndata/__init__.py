"""A user's own dataset: read, checked, masked, judged and written again; no simulator."""
